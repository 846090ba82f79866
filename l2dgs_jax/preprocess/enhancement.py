"""Brightening dark frames before training: the alternative to learning a well-lit scene from dark frames."""

import dataclasses
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.config import Enhancement
from l2dgs_jax.data import Dataset
from l2dgs_jax.data.color import MID_GREY, brightening_exponent
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.preprocess import zero_dce
from l2dgs_jax.runtime.prefetch import prefetch

CLIP_LIMIT, TILES = 3.0, (8, 8)  # of CLAHE

Enhancer = Callable[[Float32[np.ndarray, "H W 3"]], Float[np.ndarray, "H W 3"]]


def enhanced(dataset: Dataset, method: Enhancement, seed: int = 0) -> Dataset:
    """The data set with brighter training frames; held-out frames stay unchanged, for comparison.

    Args:
        dataset: the scene.
        method: "gamma": one exponent for all frames, which brings the mean of their values to about mid-grey; "clahe":
            the same, then CLAHE (Zuiderveld, 1994) on the lightness of each frame; "zero-dce": curves from a network
            (arXiv 2001.06826) that is trained on these very frames; "none": the data set itself.
        seed: of the training of that network.
    """
    if method == "none":
        return dataset
    split = dataset.train
    enhance = _enhancer(split, method, seed)
    images = split.images
    frames = prefetch(lambda i: enhance(images[i].astype(np.float32)), range(len(images)))
    bright = stacked(frames, images.shape, images.dtype, in_file=isinstance(images, MappedArray))
    source = dataset.source and dataset.source._replace(enhance=method)
    return dataclasses.replace(dataset, train=dataclasses.replace(split, images=bright), source=source)


def _enhancer(split: Split, method: Enhancement, seed: int) -> Enhancer:
    if method == "zero-dce":
        net, bend = zero_dce.learn(split, seed), jax.jit(zero_dce.brighten)
        return lambda image: np.asarray(bend(net, jnp.asarray(image, float)[None])[0])
    exponent = np.float32(brightening_exponent(split.mean_level, MID_GREY))
    if method == "gamma":
        return lambda image: image**exponent

    def clahe(image: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
        lab = cv2.cvtColor(image**exponent, cv2.COLOR_RGB2LAB)
        # 8 bits, because with 16-bit levels the clip limit of a small tile would be less than one pixel per level. A
        # new object every time, because threads cannot share one.
        lightness = np.round(lab[..., 0] * 2.55).astype(np.uint8)
        lab[..., 0] = cv2.createCLAHE(CLIP_LIMIT, TILES).apply(lightness) / np.float32(2.55)
        return np.clip(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), 0, 1)

    return clahe
