"""From light to the numbers of an image: lens, noise, mosaic and tone, as a camera's electronics do it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from jaxmap.simulation.recipe import ExposureRecipe

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def develop(
    radiance: Float32[np.ndarray, "H W 3"],
    recipe: ExposureRecipe,
    gain: float,
    rng: np.random.Generator,
    corner: Float[np.ndarray, "H W"],
) -> UInt8[np.ndarray, "H W 3"]:
    """The image (RGB) that a camera makes of a picture of radiance.

    Args:
        radiance: linear RGB.
        recipe: of the camera.
        gain: what the light is multiplied by; 1 is full scale afterwards.
        rng: draws the noise.
        corner: squared distance of pixels from the middle, 1 in the corners.
    """
    light = radiance * np.float32(gain) * np.array(recipe.white_balance, np.float32)
    light *= (1 - recipe.vignetting * corner)[..., None].astype(np.float32)
    light = cv2.GaussianBlur(light, (0, 0), recipe.blur_px)
    shot = np.sqrt(np.maximum(light, 0) / np.float32(recipe.photons))
    light = light + rng.standard_normal(light.shape, np.float32) * np.hypot(shot, np.float32(recipe.read_noise))
    if recipe.mosaic:
        light = _through_mosaic(light)
    grey = light @ _LUMINANCE
    light = grey[..., None] + np.float32(recipe.saturation) * (light - grey[..., None])
    tone = np.clip(_shoulder(light), 0, 1) ** np.float32(1 / recipe.gamma)
    curve = tone * tone * (3 - 2 * tone)
    tone += np.float32(recipe.contrast) * (curve - tone)
    return np.clip(tone * 255 + 0.5, 0, 255).astype(np.uint8)


def exposure_gain(recipe: ExposureRecipe, sand_radiance: float) -> float:
    """The gain that brings sand of this radiance, in full light, to the level of the recipe."""
    return recipe.level / max(sand_radiance, 1e-9)


def corner_distance(height_px: int, width_px: int) -> Float[np.ndarray, "H W"]:
    """Squared distance of pixels from the middle of the image, 1 in its corners."""
    v, u = np.mgrid[-1 : 1 : height_px * 1j, -1 : 1 : width_px * 1j]
    aspect = (height_px / width_px) ** 2
    return (u**2 + aspect * v**2) / (1 + aspect)


def _shoulder(light: np.ndarray) -> np.ndarray:
    """Linear up to 0.65, then ever flatter: bright sky is not cut off hard."""
    over = np.maximum(light - np.float32(0.65), 0)
    return np.minimum(light, np.float32(0.65)) + np.float32(0.35) * (1 - np.exp(-over / np.float32(0.35)))


def _through_mosaic(light: np.ndarray) -> np.ndarray:
    """Takes one colour per pixel (red, green, green, blue) and fills the others in bilinearly."""
    rows, columns = np.indices(light.shape[:2])
    kernel = np.array([[0.25, 0.5, 0.25], [0.5, 1, 0.5], [0.25, 0.5, 0.25]], np.float32)
    filled = np.empty_like(light)
    for channel in range(3):
        taken = ((rows % 2) + (columns % 2) == channel).astype(np.float32)
        filled[..., channel] = cv2.filter2D(light[..., channel] * taken, -1, kernel) / cv2.filter2D(taken, -1, kernel)
    return filled
