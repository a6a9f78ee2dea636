"""Augmentation: scaled, mirrored crops of images, masks and relief, and changes of light, in one compiled function.

A crop is drawn as a `CropWindow`, which maps every pixel of the crop to a place on the image. Colours are interpolated
bilinearly; labels are those of the nearest pixel, so that no new label arises.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped, UInt8

from jaxmap.geometry.relief import RELIEF_STRIDE
from jaxmap.labels import IGNORE
from jaxmap.training.options import AugmentationOptions

_LUMA = (0.299, 0.587, 0.114)


class CropWindow(NamedTuple):
    """Where a crop lies on its image.

    Attributes:
        scale: crop pixels per image pixel.
        offset_px: (row, column) of the crop's first pixel on the scaled image; negative where the crop
            begins outside it.
        mirrored: whether the image is mirrored, left to right, before it is cropped.
    """

    scale: Float[Array, ""]
    offset_px: Int[Array, "2"]
    mirrored: Bool[Array, ""]


class Crop(NamedTuple):
    """A training example: an image of 0 to 255, its labels, and its relief, where the network sees any."""

    image: Float[Array, "h w 3"]
    labels: UInt8[Array, "h w"]
    relief: Float[Array, "rh rw R"] | None = None


def draw_window(
    key: PRNGKeyArray, labels: UInt8[Array, "H W"], size_px: Int[Array, "2"], options: AugmentationOptions
) -> CropWindow:
    """Draws a crop of an image of `size_px` (height, width).

    Where the scaled image is smaller than the crop, it lies somewhere within it. `options.class_share` of the crops
    hold a random pixel of a random class of the image: in large crops drawn evenly, rare classes would be rare.
    """
    scale_key, offset_key, mirror_key = jax.random.split(key, 3)
    scale = jax.random.uniform(scale_key, minval=options.scale[0], maxval=options.scale[1])
    crop_px = jnp.array(options.crop_px)
    spare_px = jnp.floor(size_px * scale).astype(jnp.int32) - crop_px
    low, high = jnp.minimum(spare_px, 0), jnp.maximum(spare_px, 0)
    offset_px = jax.random.randint(offset_key, (2,), low, high + 1)
    mirrored = jax.random.bernoulli(mirror_key) & options.mirror
    if options.class_share:
        chosen_key, pixel_key, place_key = jax.random.split(jax.random.fold_in(key, 1), 3)
        row, column = draw_pixel(pixel_key, labels, size_px)
        pixel = jnp.stack([row, jnp.where(mirrored, size_px[1] - 1 - column, column)])
        place = jax.random.randint(place_key, (2,), 0, crop_px)
        around = jnp.clip(jnp.floor((pixel + 0.5) * scale).astype(jnp.int32) - place, low, high)
        offset_px = jnp.where(jax.random.bernoulli(chosen_key, options.class_share), around, offset_px)
    return CropWindow(scale, offset_px, mirrored)


def draw_pixel(
    key: PRNGKeyArray, labels: UInt8[Array, "H W"], size_px: Int[Array, "2"]
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Row and column of a random pixel of a random class among those of an image of `size_px`; (0, 0) without any."""
    class_key, row_key, column_key = jax.random.split(key, 3)
    rows, columns = (jnp.arange(count) for count in labels.shape)
    labels = jnp.where((rows < size_px[0])[:, None] & (columns < size_px[1]), labels, IGNORE)
    present = jnp.zeros(256, bool).at[labels.reshape(-1)].set(True).at[IGNORE].set(False)
    chosen = _draw_place(class_key, present)
    row = _draw_place(row_key, (labels == chosen).sum(axis=1))
    column = _draw_place(column_key, labels[row] == chosen)
    found = present.any()
    return jnp.where(found, row, 0), jnp.where(found, column, 0)


def _draw_place(key: PRNGKeyArray, counts: Int[Array, "N"] | Bool[Array, "N"]) -> Int[Array, ""]:
    """An index, with a probability proportional to its count."""
    reached = jnp.cumsum(counts.astype(jnp.int32))
    drawn = jax.random.randint(key, (), 0, jnp.maximum(reached[-1], 1))
    return jnp.searchsorted(reached, drawn, side="right").astype(jnp.int32)


def whole_window(size_px: Int[Array, "2"], crop_px: tuple[int, int]) -> CropWindow:
    """The whole image in the middle of the crop, as large as fits."""
    scale = (jnp.array(crop_px) / size_px).min()
    spare_px = jnp.round(size_px * scale).astype(jnp.int32) - jnp.array(crop_px)
    return CropWindow(scale, spare_px // 2, jnp.zeros((), bool))


def cut(
    window: CropWindow,
    image: UInt8[Array, "H W 3"],
    labels: UInt8[Array, "H W"],
    size_px: Int[Array, "2"],
    crop_px: tuple[int, int],
    fill: tuple[float, ...],
) -> tuple[Float[Array, "h w 3"], UInt8[Array, "h w"]]:
    """Cuts a window out of an image and its labels.

    Args:
        window: where the crop lies.
        image: RGB, 0 to 255; may be padded at the bottom and on the right.
        labels: of the same pixels.
        size_px: height and width of the image without the padding.
        crop_px: height and width of the crop.
        fill: colour of pixels outside the image; their label is `IGNORE`.

    Returns:
        The crop, 0 to 255, and its labels.
    """
    near = cut_nearest(window, labels, size_px, crop_px, IGNORE)
    return _cut_linear(window, image, size_px, crop_px, jnp.array(fill)), near


def cut_nearest(
    window: CropWindow, values: Shaped[Array, "H W"], size_px: Int[Array, "2"], crop_px: tuple[int, int], outside: float
) -> Shaped[Array, "h w"]:
    """Cuts a window out of values that cannot be interpolated; pixels outside the image are `outside`."""
    rows, columns = (_positions(window, axis, size_px[axis], crop_px[axis]) for axis in (0, 1))
    inside = rows.inside[:, None] & columns.inside[None, :]
    return jnp.where(inside, values[rows.nearest][:, columns.nearest], outside).astype(values.dtype)


def cut_relief(
    window: CropWindow, relief: Float[Array, "h w R"], size_px: Int[Array, "2"], crop_px: tuple[int, int]
) -> Float[Array, "rh rw R"]:
    """Cuts a window of an image of `size_px` out of its relief, unknown (0) outside; metres stay what they are.

    Pixel j of relief lies over the pixels from `RELIEF_STRIDE j` on, of the crop as of the image.
    """
    coarse = CropWindow(window.scale, window.offset_px / RELIEF_STRIDE, window.mirrored)
    rows, columns = (-(-size // RELIEF_STRIDE) for size in crop_px)
    return _cut_linear(coarse, relief, size_px / RELIEF_STRIDE, (rows, columns), jnp.zeros(()))


def _cut_linear(window: CropWindow, values: Array, size_px: Array, crop_px: tuple[int, int], outside: Array) -> Array:
    """Cuts a window out of an image of vectors, interpolating bilinearly; what lies beyond is `outside`."""
    rows, columns = (_positions(window, axis, size_px[axis], crop_px[axis]) for axis in (0, 1))
    inside = rows.inside[:, None] & columns.inside[None, :]
    values = values.astype(jnp.float32)
    values = _between(values[rows.low], values[rows.high], rows.share[:, None, None])
    values = _between(values[:, columns.low], values[:, columns.high], columns.share[None, :, None])
    return jnp.where(inside[..., None], values, outside)


class _Positions(NamedTuple):
    """Where the rows (or columns) of a crop lie on its image."""

    nearest: Array
    low: Array
    high: Array
    share: Array
    inside: Array


def _positions(window: CropWindow, axis: int, size: Array, count: int) -> _Positions:
    exact = (jnp.arange(count) + window.offset_px[axis] + 0.5) / window.scale - 0.5
    if axis == 1:
        exact = jnp.where(window.mirrored, size - 1 - exact, exact)
    nearest = jnp.floor(exact + 0.5).astype(jnp.int32)
    inside = (nearest >= 0) & (nearest < size)
    # Of relief, the last pixel may lie over less than a whole one.
    last = jnp.ceil(size).astype(jnp.int32) - 1
    exact = jnp.clip(exact, 0, last)
    low = jnp.floor(exact).astype(jnp.int32)
    return _Positions(jnp.clip(nearest, 0, last), low, jnp.minimum(low + 1, last), exact - low, inside)


def _between(before: Array, after: Array, share: Array) -> Array:
    return before + (after - before) * share


def change_light(
    key: PRNGKeyArray, image: Float[Array, "h w 3"], options: AugmentationOptions
) -> Float[Array, "h w 3"]:
    """Changes hue, saturation, tint, contrast, brightness, gamma and noise, or turns all to grey, as the options say.

    A change whose option is 0 is not compiled in.
    """
    keys = jax.random.split(key, 8)

    def factor(index: int, spread: float) -> Array:
        return jnp.exp(jax.random.uniform(keys[index], minval=-1.0, maxval=1.0) * jnp.log1p(spread))

    red, green, blue = (image[..., channel] for channel in range(3))
    if options.hue_rad:
        red, green, blue = _rotated(jax.random.uniform(keys[0], minval=-1.0) * options.hue_rad, red, green, blue)
    if options.saturation:
        amount, grey = factor(1, options.saturation), _luma(red, green, blue)
        red, green, blue = (_between(grey, channel, amount) for channel in (red, green, blue))
    if options.tint:
        gains = jnp.exp(jax.random.uniform(keys[6], (3,), minval=-1.0) * jnp.log1p(options.tint))
        red, green, blue = (channel * gain for channel, gain in zip((red, green, blue), gains, strict=True))
    if options.contrast:
        amount, level = factor(2, options.contrast), _luma(red, green, blue).mean()
        red, green, blue = (_between(level, channel, amount) for channel in (red, green, blue))
    if options.brightness:
        amount = factor(3, options.brightness)
        red, green, blue = (channel * amount for channel in (red, green, blue))
    image = jnp.clip(jnp.stack([red, green, blue], axis=-1), 0, 255)
    if options.gamma:
        image = 255 * (image / 255) ** factor(4, options.gamma)
    if options.noise:
        image = jnp.clip(image + options.noise * jax.random.normal(keys[5], image.shape), 0, 255)
    if options.grey:
        # At last: the noise of a grey camera is grey.
        luma = jnp.broadcast_to(_luma(*jnp.moveaxis(image, -1, 0))[..., None], image.shape)
        image = jnp.where(jax.random.bernoulli(keys[7], options.grey), luma, image)
    return image


def _luma(red: Array, green: Array, blue: Array) -> Array:
    return _LUMA[0] * red + _LUMA[1] * green + _LUMA[2] * blue


def _rotated(angle_rad: Array, red: Array, green: Array, blue: Array) -> tuple[Array, Array, Array]:
    """Colours rotated around the grey axis, which leaves greys unchanged (Rodrigues' formula)."""
    cosine, sine = jnp.cos(angle_rad), jnp.sin(angle_rad) / jnp.sqrt(3.0)
    grey = (red + green + blue) * ((1 - cosine) / 3)
    return (
        red * cosine + (blue - green) * sine + grey,
        green * cosine + (red - blue) * sine + grey,
        blue * cosine + (green - red) * sine + grey,
    )


def augment(
    key: PRNGKeyArray,
    image: UInt8[Array, "H W 3"],
    labels: UInt8[Array, "H W"],
    size_px: Int[Array, "2"],
    original: Bool[Array, ""],
    options: AugmentationOptions,
    fill: tuple[float, ...],
    relief: Float[Array, "rH rW R"] | None = None,
) -> Crop:
    """One training example: a random crop with its light and relief changed, or the whole image where `original`."""
    window_key, light_key = jax.random.split(key)
    drawn = draw_window(window_key, labels, size_px, options)
    window = jax.tree.map(
        lambda whole, part: jnp.where(original, whole, part), whole_window(size_px, options.crop_px), drawn
    )
    crop, near = cut(window, image, labels, size_px, options.crop_px, fill)
    lit = change_light_inside(light_key, window, crop, size_px, options)
    if relief is None:
        return Crop(jnp.where(original, crop, lit), near)
    part = cut_relief(window, relief, size_px, options.crop_px)
    lit, changed = change_relief(jax.random.fold_in(key, 1), lit, part, options, fill)
    return Crop(jnp.where(original, crop, lit), near, jnp.where(original, part, changed))


def change_relief(
    key: PRNGKeyArray,
    image: Float[Array, "h w 3"],
    relief: Float[Array, "rh rw R"],
    options: AugmentationOptions,
    fill: tuple[float, ...],
) -> tuple[Float[Array, "h w 3"], Float[Array, "rh rw R"]]:
    """Disturbs the relief, and takes away one of the two inputs of some examples, so that neither is trusted blindly.

    The image, which becomes flat, is only taken away where there is relief to learn from.
    """
    disturb_key, drop_key = jax.random.split(key)
    if options.disturb_relief:
        relief = disturb_relief(disturb_key, relief, options.disturb_relief)
    chance = jax.random.uniform(drop_key)
    if options.drop_image:
        flat = (chance > 1 - options.drop_image) & (relief[..., -1] > 0).any()
        image = jnp.where(flat, jnp.array(fill), image)
    return image, jnp.where(chance < options.drop_relief, 0.0, relief)


def disturb_relief(key: PRNGKeyArray, relief: Float[Array, "h w R"], strength: float) -> Float[Array, "h w R"]:
    """Offsets, tilts, bumps and noise in the channels of relief, and holes in which it is unknown.

    The amount is drawn evenly up to `strength`, which is the standard deviation in units of the channels.
    """
    height, width, channels = relief.shape
    amount_key, shift_key, noise_key, hole_key = jax.random.split(key, 4)
    amount = strength * jax.random.uniform(amount_key)

    def smooth(key: Array, nodes: int, count: int) -> Array:
        drawn = jax.random.normal(key, (nodes, nodes, count))
        return jax.image.resize(drawn, (height, width, count), "linear")

    noise = 0.5 * jax.random.normal(noise_key, (height, width, channels - 1))
    error = amount * (smooth(shift_key, 3, channels - 1) + noise) * relief[..., -1:]
    hole = smooth(hole_key, 8, 1) < 2 * amount - 2
    return jnp.where(hole, 0.0, relief.at[..., :-1].add(error))


def change_light_inside(
    key: PRNGKeyArray,
    window: CropWindow,
    crop: Float[Array, "h w 3"],
    size_px: Int[Array, "2"],
    options: AugmentationOptions,
) -> Float[Array, "h w 3"]:
    """`change_light` of the pixels inside the image; the others keep the fill colour."""
    rows, columns = (_positions(window, axis, size_px[axis], options.crop_px[axis]).inside for axis in (0, 1))
    outside = ~(rows[:, None] & columns[None, :])
    return jnp.where(outside[..., None], crop, change_light(key, crop, options))
