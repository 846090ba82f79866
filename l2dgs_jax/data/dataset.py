"""The data set that every reader returns."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from l2dgs_jax.cameras.geometry import select_camera
from l2dgs_jax.data.lens import Lens
from l2dgs_jax.data.stacks import pixel_mean
from l2dgs_jax.types import Camera

SATURATED = 0.98  # sRGB value from which a channel counts as saturated


class Source(NamedTuple):
    """The arguments of `load_dataset`, and later changes of the frames; `Config` has settings of the same names.

    Attributes:
        scene: absolute path of its folder, or "demo".
        downscale: see `load_dataset`.
        format: see `load_dataset`.
        held_out: see `load_dataset`.
        frame_memory: see `load_dataset`.
        normalise: see `load_dataset`.
        enhance: how the training frames were brightened after loading (preprocess/enhancement.py).
    """

    scene: str
    downscale: int
    format: str
    held_out: str
    frame_memory: float
    normalise: bool = True
    enhance: str = "none"

    @property
    def settings(self) -> dict[str, Any]:
        """All but the scene, by their names in `Config`."""
        return {name: value for name, value in self._asdict().items() if name != "scene"}


class Original(NamedTuple):
    """The picture that a frame was read from.

    Attributes:
        size: width and height in pixels.
        K: intrinsics, skew included.
        lens: its distortion.
    """

    size: tuple[int, int]
    K: Float[np.ndarray, "3 3"]
    lens: Lens


@dataclass(frozen=True)
class Split:
    """Frames of a scene as NumPy arrays; if they exceed a memory budget, stacks of frames are `MappedArray`s.

    Attributes:
        names: of the frames.
        cameras: stacked float32 arrays; K is that of the images below, which have no distortion, and has no skew.
        images: low-light sRGB values in [0, 1]. Half floats keep the precision that averaging dark 8-bit pixels gains.
        welllit: the same views at normal exposure, sRGB values in [0, 1], if the scene has them.
        masks: True where something moves, if the scene has them.
        valid: False for pixels that are neither learned from nor scored; None if all pixels count.
        covisible: True where enough training views see the same place, if the scene has it (arXiv 2210.13445).
        depths: along the optical axis, 0 where unknown, if the scene has them. Only differences of inverse depth within
            a frame count, up to an unknown factor: networks that estimate depth tell no more.
        originals: the full-size pictures on disk, for code that writes matching ones.
    """

    names: tuple[str, ...]
    cameras: Camera
    images: Float[np.ndarray, "F H W 3"]
    welllit: Float[np.ndarray, "F H W 3"] | None = None
    masks: Bool[np.ndarray, "F H W"] | None = None
    valid: Bool[np.ndarray, "F H W"] | None = None
    covisible: Bool[np.ndarray, "F H W"] | None = None
    depths: Float32[np.ndarray, "F H W"] | None = None
    originals: tuple[Original, ...] = ()

    @cached_property
    def mean_level(self) -> float:
        """Mean sRGB value of all pixels that count and are not saturated, as lamps are; 1 if there are none."""
        with np.errstate(invalid="ignore"):
            mean = pixel_mean(self.images, self.valid, below=SATURATED).mean()
        return float(np.nan_to_num(mean, nan=1.0))

    def camera(self, index: int) -> Camera:
        """The camera of one frame."""
        return select_camera(self.cameras, index)


@dataclass(frozen=True)
class Dataset:
    """A scene, independent of the layout of its files.

    Attributes:
        name: for messages.
        width: of every image, pixels.
        height: of every image, pixels.
        train: frames to learn from.
        test: held-out frames.
        points: where the scene has surfaces, world units.
        colors: sRGB values in [0, 1] of the points, if known.
        points_are_random: whether they only stand in for a cloud that is missing; they have no colors then.
        notes: assumptions that the reader made where the files say nothing, as sentences.
        source: where it was read from; None if it was not read from files.
    """

    name: str
    width: int
    height: int
    train: Split
    test: Split
    points: Float[np.ndarray, "P 3"]
    colors: Float[np.ndarray, "P 3"] | None = None
    points_are_random: bool = False
    notes: tuple[str, ...] = ()
    source: Source | None = None
