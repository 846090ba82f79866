"""What seems to move, but is the static scene: shadows, and what flow drags along beside moving objects."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.data.color import srgb_to_linear
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import evenly_spread, nan_median
from l2dgs_jax.training.backdrop import Backdrop, hidden_depths, unprojected
from l2dgs_jax.training.tracks import Tracks

CLIP_PART = 240  # instants of a part of a long clip, which is compared with itself: elsewhere, little of it is in view
MAX_FRAMES = 60  # frames of a part that colours of static surfaces are taken from
MAX_PIXELS = 300_000  # that are compared at once, as each needs its colours in all of these frames
MIN_SEEN = 3  # of these, in which a surface must be seen
REACH = 9  # side in pixels of the square around a track in which static surfaces may be hidden
BLUR_SIGMA = 1.0  # standard deviation in pixels of the Gaussian that suppresses noise
DARKNESS = 0.3  # of the median light; darker colours are mostly noise, and count as this
LEAST_LIGHT = 1e-4  # linear, a third of the first 8-bit level of sRGB: the median may be 0
SHADE = 0.35, 1.1  # light in a shadow over that outside, at least and at most
TINT = 0.15  # difference in log-light of a channel from the mean of all channels: a shadow changes colours little


class Likeness(NamedTuple):
    """How pixels compare with the static surfaces behind them; neither is true where these are not known.

    Attributes:
        alike: whether they have the same colours, or darker ones.
        differs: whether they have others.
    """

    alike: Bool[np.ndarray, " N"]
    differs: Bool[np.ndarray, " N"]


def likeness_to_background(
    frames: Int[np.ndarray, " N"],
    pixels: Float[np.ndarray, "N 2"],
    split: Split,
    backdrop: Backdrop,
    tracks: Tracks,
) -> Likeness:
    """Compare pixels of frames with the static surfaces behind them.

    These surfaces are seen in other frames, where nothing moves before them. Where they are not, nothing is known, nor
    is it for pixels that are not valid.

    Args:
        frames: indices of the frames.
        pixels: within the frames.
        split: all frames.
        backdrop: of these.
        tracks: what seems to move there.
    """
    times, instants = np.unique(backdrop.cameras.time, return_inverse=True)
    likeness = Likeness(*np.zeros((2, len(frames)), bool))
    for span in np.array_split(np.arange(len(times)), -(-len(times) // CLIP_PART)):
        part = np.flatnonzero(np.isin(instants, span))
        asked = np.flatnonzero(np.isin(frames, part))
        if len(asked):
            chunks = np.array_split(asked, -(-len(asked) // MAX_PIXELS))
            colors = [_colors(frames[chunk], pixels[chunk], part.tolist(), split, backdrop, tracks) for chunk in chunks]
            here, elsewhere = (np.concatenate(parts) for parts in zip(*colors, strict=True))
            known = np.isfinite(here).all(-1) & np.isfinite(elsewhere).all(-1)
            alike = known.copy()
            if known.any():
                alike[known] = _alike(here[known], elsewhere[known])
            likeness.alike[asked], likeness.differs[asked] = alike, known & ~alike
    return likeness


def _colors(
    frames: Int[np.ndarray, " N"],
    pixels: Float[np.ndarray, "N 2"],
    part: list[int],
    split: Split,
    backdrop: Backdrop,
    tracks: Tracks,
) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, "N 3"]]:
    """Light at the pixels, NaN where not valid, and of what they hide, NaN where hardly any frame shows it."""
    height, width = split.images.shape[1:3]
    viewmats, Ks, _ = backdrop.cameras
    surfaces = unprojected(backdrop.cameras, frames, pixels, hidden_depths(backdrop, frames, pixels))
    chosen = [part[i] for i in evenly_spread(len(part), MAX_FRAMES)]
    elsewhere = np.full((len(chosen), len(surfaces), 3), np.nan, np.float32)
    here = np.full((len(surfaces), 3), np.nan, np.float32)
    for frame in part:
        asked = np.flatnonzero(frames == frame)
        if frame not in chosen and not len(asked):
            continue
        light = _smooth_light(split.images[frame])
        if split.valid is not None:
            light[~split.valid[frame]] = np.nan
        column, row = pixels[asked].astype(int).T
        here[asked] = light[row, column]
        if frame in chosen:
            moving = np.zeros((height, width), np.uint8)
            column, row = tracks.pixels[tracks.frames == frame].astype(int).T
            moving[row, column] = 1
            light[cv2.dilate(moving, np.ones((REACH, REACH), np.uint8)) > 0] = np.nan
            places, depth = project_points(surfaces, viewmats[frame], Ks[frame])
            seen = np.flatnonzero((depth > 0) & ((places >= 0) & (places < (width, height))).all(-1))  # never NaN
            column, row = places[seen].astype(int).T
            elsewhere[chosen.index(frame), seen] = light[row, column]
    enough = np.isfinite(elsewhere[..., 0]).sum(0) >= MIN_SEEN
    typical = np.full_like(here, np.nan)
    typical[enough] = nan_median(elsewhere[:, enough])
    return here, typical


def _alike(here: Float32[np.ndarray, "N 3"], elsewhere: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Whether light is that of the same surface, or of its shadow."""
    least = max(DARKNESS * np.median(elsewhere), LEAST_LIGHT)
    change = np.log(np.maximum(here, least) / np.maximum(elsewhere, least))
    mean = change.mean(-1)
    tint = np.abs(change - mean[:, None]).max(-1)
    return (tint < TINT) & (mean > np.log(SHADE[0])) & (mean < np.log(SHADE[1]))


def _smooth_light(image: Float[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    return cv2.GaussianBlur(srgb_to_linear(image.astype(np.float32)), (0, 0), BLUR_SIGMA)
