"""A tone curve for every training frame, learned beside the scene: what the preset `curve-4dgs` adds to `4dgs`.

In the manner of Luminance-GS (arXiv 2504.01503): a curve shared by all views, an adjustment of it for each, and two
priors on their shape for want of a ground truth. There the curves brighten the frames that supervise the scene; here
they darken the well-lit rendering to match the frames, so that one photometric loss trains scene and curves.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.model.decomposition import clip_unit
from l2dgs_jax.model.tone import Darkening, sampled_frames
from l2dgs_jax.types import ToneCurves

RAMPS = 16  # linear segments of a curve
KNOTS: Float[np.ndarray, "16"] = np.arange(1, RAMPS + 1) / RAMPS  # well-lit values where they end
MIN_VALUE = 1 / 255  # sRGB; darker values are raised to it, as they say nothing about a curve
EXPONENT_RANGE = 0.5, 4.0  # of plausible power laws; frames of a single value would give 0

# Power laws are lines in log-log coordinates; the matrix takes the closest one away from log values at the knots.
_LINES = np.stack([np.ones(RAMPS), np.log(KNOTS)], axis=-1)
_RESIDUAL_OF_LINES = np.eye(RAMPS) - _LINES @ np.linalg.pinv(_LINES)


def power_law(law: Darkening) -> Float[np.ndarray, " R"]:
    """A darkening as a curve: logarithms of the heights of its ramps."""
    return np.log(law.gain * np.diff(KNOTS**law.exponent, prepend=0))


def of_frames(curves: ToneCurves, frames: Int[Array, " V"]) -> Float[Array, "V R"]:
    """The curves of training frames; carries gradients.

    Adjustments count relative to their mean over the frames, which the shared curve accounts for.
    """
    return curves.shared[None] + (curves.offsets - curves.offsets.mean(0, keepdims=True))[frames]


def darkened(images: Float[Array, "V H W 3"], log_rises: Float[Array, "V R"]) -> Float[Array, "V H W 3"]:
    """Well-lit images after one curve each; both arguments carry gradients.

    A curve is a sum of rising ramps side by side: monotone, piecewise linear, and 0 at 0 (arXiv 1709.09602).

    Args:
        images: sRGB in [0, 1].
        log_rises: logarithms of the heights of the ramps.
    """
    rises = jnp.exp(log_rises)[:, None, None, None]
    return jnp.stack([rises[..., k] * clip_unit(RAMPS * images - k) for k in range(RAMPS)]).sum(0)


def equalisation(
    log_rises: Float[Array, "V R"], frames: Float[Array, "V H W 3"], valid: Bool[Array, "V H W"] | None
) -> Float[Array, ""]:
    """How far curves are from those for which the well-lit images have flat histograms.

    It is the mean squared difference of log values at the knots; `log_rises` carries gradients.

    Args:
        log_rises: of the curves.
        frames: dark, sRGB in [0, 1].
        valid: which pixels count; None for all. A frame without any adds 0.
    """
    has_pixels = jnp.ones(len(frames), bool) if valid is None else valid.any((1, 2))
    distances = jnp.where(has_pixels[:, None], _log_values(log_rises) - _log_quantiles(frames, valid), 0)
    return jnp.square(distances).mean()


def bend(log_rises: Float[Array, "V R"]) -> Float[Array, ""]:
    """Mean squared difference of log values at the knots from the closest power laws; carries gradients."""
    return jnp.square(_log_values(log_rises) @ jnp.asarray(_RESIDUAL_OF_LINES, log_rises.dtype)).mean()


def equalising_law(frames: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None) -> Darkening:
    """The power law closest to the curve that `equalisation` aims at, the pixels of all frames pooled."""
    sampled = sampled_frames(len(frames), valid)
    pixels = jnp.asarray(frames[sampled].reshape(1, -1, *frames.shape[2:]), float)
    counted = None if valid is None else jnp.asarray(valid[sampled].reshape(1, -1, frames.shape[2]))
    log_dark, log_lit = np.asarray(_log_quantiles(pixels, counted)[0]), np.log(KNOTS)
    exponent = float(np.clip(np.polyfit(log_lit, log_dark, 1)[0], *EXPONENT_RANGE))
    return Darkening(exponent, float(np.exp(np.mean(log_dark - exponent * log_lit))))


def _log_values(log_rises: Float[Array, "V R"]) -> Float[Array, "V R"]:
    """Logarithms of curves at the knots."""
    return jax.lax.cumlogsumexp(log_rises, axis=1)


def _log_quantiles(frames: Float[Array, "V H W 3"], valid: Bool[Array, "V H W"] | None) -> Float[Array, "V R"]:
    """Logarithms of the quantiles at `KNOTS` of the frames' grey values."""
    grey = frames.mean(-1)
    counted = jnp.ones(grey.shape, bool) if valid is None else valid
    ordered = jnp.sort(jnp.where(counted, grey, jnp.inf).reshape(len(grey), -1))
    last = jnp.maximum(counted.sum((1, 2)) - 1, 0)[:, None]
    places = jnp.round(last.astype(grey.dtype) * jnp.asarray(KNOTS, grey.dtype)[None]).astype(last.dtype)
    places = jnp.minimum(places, last)  # above 2^24, a float32 may be larger
    return jnp.log(jnp.maximum(jnp.take_along_axis(ordered, places, axis=1), MIN_VALUE))
