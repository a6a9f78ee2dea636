// Vectors of small integers, of a length that is chosen.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__SSE4_1__)
#include <immintrin.h>
#endif

namespace jaxmap {

#if defined(__AVX512BW__)
constexpr int kWidest = 64;
#else
constexpr int kWidest = 32;
#endif

template <typename Number, int kBytes>
struct VectorOf {
  typedef Number type __attribute__((vector_size(kBytes)));
};

template <typename Vector>
inline Vector load(const void* from) {
  Vector vector;
  std::memcpy(&vector, from, sizeof(Vector));
  return vector;
}

template <typename Vector>
inline void store(void* to, Vector vector) {
  std::memcpy(to, &vector, sizeof(Vector));
}

// To memory past the caches, for what is read much later; `to` must be aligned, and `all_stored` called after the last.
template <typename Vector>
inline void store_for_later(void* to, Vector vector) {
#if defined(__AVX512F__)
  if constexpr (sizeof(Vector) == 64) return _mm512_stream_si512(static_cast<__m512i*>(to), (__m512i)vector);
#endif
#if defined(__AVX__)
  if constexpr (sizeof(Vector) == 32) return _mm256_stream_si256(static_cast<__m256i*>(to), (__m256i)vector);
#endif
  store(to, vector);
}

inline void all_stored() {
#if defined(__AVX__)
  _mm_sfence();
#endif
}

template <typename Vector>
inline Vector lesser(Vector a, Vector b) {
  return a < b ? a : b;
}

// The upper half of the products of 16-bit numbers.
template <typename Words>
inline Words high_product(Words words, uint16_t factor) {
#if defined(__AVX512BW__)
  if constexpr (sizeof(Words) == 64) return (Words)_mm512_mulhi_epu16((__m512i)words, _mm512_set1_epi16(factor));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Words) == 32) return (Words)_mm256_mulhi_epu16((__m256i)words, _mm256_set1_epi16(factor));
#endif
  for (size_t i = 0; i < sizeof(Words) / 2; ++i) words[i] = uint16_t((uint32_t(words[i]) * factor) >> 16);
  return words;
}

// The lanes of a vector moved up by one, with the last of the one before it; and down, with the first of the next.
template <typename Bytes, int... kLane>
inline Bytes moved_up(Bytes before, Bytes here, std::integer_sequence<int, kLane...>) {
  return __builtin_shufflevector(before, here, (kLane + int(sizeof(Bytes)) - 1)...);
}
template <typename Bytes, int... kLane>
inline Bytes moved_down(Bytes here, Bytes next, std::integer_sequence<int, kLane...>) {
  return __builtin_shufflevector(here, next, (kLane + 1)...);
}

// The least lane of a vector, in all lanes of another: halves are compared until 16 bytes are left.
template <typename Vector>
inline Vector least_of(Vector vector) {
  using Number = std::decay_t<decltype(vector[0])>;
  constexpr int kLeft = sizeof(Vector) / 16;
  using Short = typename VectorOf<Number, 16>::type;
  Short parts[kLeft];
  std::memcpy(parts, &vector, sizeof(Vector));
  for (int count = kLeft / 2; count > 0; count /= 2)
    for (int i = 0; i < count; ++i) parts[i] = lesser(parts[i], parts[i + count]);
#if defined(__SSE4_1__)
  using Bytes = VectorOf<uint8_t, 16>::type;
  using Words = VectorOf<uint16_t, 16>::type;
  Words words = (Words)parts[0];
  if (sizeof(Number) == 1) words = (Words)lesser((Bytes)words, (Bytes)(words >> 8));  // its upper bytes are 0
  const __m128i least = _mm_minpos_epu16((__m128i)words);
#if defined(__AVX512BW__)
  if constexpr (sizeof(Vector) == 64)
    return (Vector)(sizeof(Number) == 1 ? _mm512_broadcastb_epi8(least) : _mm512_broadcastw_epi16(least));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Vector) == 32)
    return (Vector)(sizeof(Number) == 1 ? _mm256_broadcastb_epi8(least) : _mm256_broadcastw_epi16(least));
#endif
  return Vector{} + Number(_mm_cvtsi128_si32(least));
#else
  Number least = parts[0][0];
  for (size_t i = 1; i < 16 / sizeof(Number); ++i) least = std::min<Number>(least, parts[0][i]);
  return Vector{} + least;
#endif
}

}  // namespace jaxmap
