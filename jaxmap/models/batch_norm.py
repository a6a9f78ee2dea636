"""Batch norm (Ioffe & Szegedy 2015) or a bias, with the activation that follows, and their gradients.

The gradients are written by hand: what autodiff keeps of these few operations on every pixel (differences,
masks, rescaled copies) is several times the images themselves, and reading it costs more than computing.
Here only the inputs are kept, and the mask of the activation is recomputed from them.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from jaxmap.models.architecture import Activation

Images = Float[Array, "B H W C"]
PerChannel = Float[Array, "C"]

_PIXELS = (0, 1, 2)
_CEILINGS: dict[Activation, float] = {"relu": jnp.inf, "relu6": 6.0}


def activate(values: Float[Array, "*shape"], activation: Activation) -> Float[Array, "*shape"]:
    """Applies an activation."""
    if activation == "none":
        return values
    return jax.nn.relu(values) if activation == "relu" else jnp.clip(values, 0, _CEILINGS[activation])


def _passes(values: Float[Array, "*shape"], activation: Activation) -> Bool[Array, "*shape"]:
    """Where the derivative of an activation is 1; elsewhere it is 0."""
    return (values > 0) & (values < _CEILINGS[activation])


def _masked(cotangent: Images, values: Images, activation: Activation) -> Images:
    """The cotangent of the input of an activation."""
    return cotangent if activation == "none" else jnp.where(_passes(values, activation), cotangent, 0)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def add_bias(images: Images, bias: PerChannel, activation: Activation) -> Images:
    """`activation(images + bias)`."""
    return activate(images + bias, activation)


def _add_bias_forward(images: Images, bias: PerChannel, activation: Activation) -> tuple[Images, Images | None]:
    result = activate(images + bias, activation)
    return result, None if activation == "none" else result


def _add_bias_backward(activation: Activation, result: Images | None, cotangent: Images) -> tuple[Images, PerChannel]:
    # The result passes where the input of the activation does.
    masked = cotangent if result is None else _masked(cotangent, result, activation)
    return masked, masked.sum(_PIXELS)


add_bias.defvjp(_add_bias_forward, _add_bias_backward)


def _scaled(images: Images, mean: PerChannel, gain: PerChannel, bias: PerChannel, activation: Activation) -> Images:
    return activate((images - mean) * gain + bias, activation)


Residuals = tuple[Images, PerChannel, PerChannel, PerChannel, PerChannel]
"""Images, mean and 1 / standard deviation, scale, bias."""


@partial(jax.custom_vjp, nondiff_argnums=(5,))
def normalise(
    images: Images,
    mean: PerChannel,
    inverse_std: PerChannel,
    scale: PerChannel,
    bias: PerChannel,
    activation: Activation,
) -> Images:
    """`activation((images - mean) inverse_std scale + bias)`, for statistics that are constants."""
    return _scaled(images, mean, inverse_std * scale, bias, activation)


def _normalise_forward(
    images: Images,
    mean: PerChannel,
    inverse_std: PerChannel,
    scale: PerChannel,
    bias: PerChannel,
    activation: Activation,
) -> tuple[Images, Residuals]:
    result = _scaled(images, mean, inverse_std * scale, bias, activation)
    return result, (images, mean, inverse_std, scale, bias)


def _sums(residuals: Residuals, cotangent: Images, activation: Activation) -> tuple[Images, Images, Array, Array]:
    """Normalised images, cotangent before the activation, and the gradients of scale and bias."""
    images, mean, inverse_std, scale, bias = residuals
    normal = (images - mean) * inverse_std
    masked = _masked(cotangent, normal * scale + bias, activation)
    return normal, masked, (masked * normal).sum(_PIXELS), masked.sum(_PIXELS)


def _normalise_backward(
    activation: Activation, residuals: Residuals, cotangent: Images
) -> tuple[Images, Array, Array, Array, Array]:
    _, _, inverse_std, scale, _ = residuals
    _, masked, of_scale, of_bias = _sums(residuals, cotangent, activation)
    return (
        masked * (inverse_std * scale),
        -of_bias * inverse_std * scale,
        of_scale * scale / inverse_std,
        of_scale,
        of_bias,
    )


normalise.defvjp(_normalise_forward, _normalise_backward)


def normalise_by_batch(
    images: Images, scale: PerChannel, bias: PerChannel, eps: float, activation: Activation
) -> tuple[Images, PerChannel, PerChannel]:
    """Normalises by the statistics of the images themselves.

    Args:
        images: to be normalised.
        scale: after the normalisation.
        bias: after the scale.
        eps: added to the variance.
        activation: applied last.

    Returns:
        The result, and mean and variance (of the population) of the images, through which no gradient flows.
    """
    return _by_batch(images, scale, bias, eps, activation)


def _by_batch_forward(
    images: Images, scale: PerChannel, bias: PerChannel, eps: float, activation: Activation
) -> tuple[tuple[Images, PerChannel, PerChannel], Residuals]:
    mean = images.mean(_PIXELS)
    # Two passes: mean(x^2) - mean(x)^2 would cancel where the mean is far from 0.
    variance = jnp.square(images - mean).mean(_PIXELS)
    inverse_std = jax.lax.rsqrt(variance + eps)
    result = _scaled(images, mean, inverse_std * scale, bias, activation)
    return (result, mean, variance), (images, mean, inverse_std, scale, bias)


def _by_batch_backward(
    eps: float, activation: Activation, residuals: Residuals, cotangents: tuple[Images, Array, Array]
) -> tuple[Images, PerChannel, PerChannel]:
    """Ioffe & Szegedy 2015, section 3, with the sums over the batch gathered."""
    _, _, inverse_std, scale, _ = residuals
    normal, masked, of_scale, of_bias = _sums(residuals, cotangents[0], activation)
    count = masked.size // masked.shape[-1]
    images = (masked - of_bias / count - normal * (of_scale / count)) * (inverse_std * scale)
    return images, of_scale, of_bias


_by_batch = jax.custom_vjp(lambda *arguments: _by_batch_forward(*arguments)[0], nondiff_argnums=(3, 4))
_by_batch.defvjp(_by_batch_forward, _by_batch_backward)


class BatchNorm(nnx.BatchNorm):
    """Batch norm and the activation after it; weights `scale`, `bias`, `mean`, `var` (C,).

    Its running statistics follow torch's rule: the variance that they take up is the sample's, not the
    population's by which the batch itself is normalised.
    """

    def __call__(self, images: Images, activation: Activation = "none") -> Images:  # type: ignore[override]
        """Normalises by the running statistics, or, without `use_running_average`, by the batch, which they follow."""
        assert self.scale is not None and self.bias is not None
        scale, bias = self.scale[...], self.bias[...]
        if self.use_running_average:
            inverse_std = jax.lax.rsqrt(self.var[...] + self.epsilon)
            return normalise(images, self.mean[...], inverse_std, scale, bias, activation)
        result, mean, variance = normalise_by_batch(images, scale, bias, self.epsilon, activation)
        count = images.size // images.shape[-1]
        sample = variance * (count / max(count - 1, 1))
        self.mean[...] = self.momentum * self.mean[...] + (1 - self.momentum) * mean
        self.var[...] = self.momentum * self.var[...] + (1 - self.momentum) * sample
        return result
