"""Stereo matching in JAX: a rectified pair in, disparity out, inside the compiled step."""
