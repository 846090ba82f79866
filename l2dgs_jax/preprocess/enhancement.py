"""Dark frames brightened one by one before anything is learned of the scene: the other way to a well-lit one."""

import dataclasses
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.config import Enhancement
from l2dgs_jax.data import Dataset
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.preprocess import zero_dce
from l2dgs_jax.runtime.prefetch import prefetch

LEVEL = 0.46  # mean that a gamma brings the frames to: photographers' middle grey, 18 % linear, in sRGB
CLIP_LIMIT, TILES = 3.0, (8, 8)  # of CLAHE

Enhancer = Callable[[Float32[np.ndarray, "H W 3"]], Float[np.ndarray, "H W 3"]]


def enhanced(dataset: Dataset, method: Enhancement, seed: int = 0) -> Dataset:
    """The data set with brighter training frames; held-out frames stay what they are, to be compared with.

    Args:
        dataset: the scene.
        method: "gamma": one exponent for all frames, which brings the mean of their values to about mid-grey; "clahe":
            that, and CLAHE (Zuiderveld, 1994) on the lightness of each; "zero-dce": curves of a network (arXiv
            2001.06826) that is trained on these very frames; "none".
        seed: of that training.
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
        net, bend = zero_dce.learn(split.images, seed), jax.jit(zero_dce.brighten)
        return lambda image: np.asarray(bend(net, jnp.asarray(image, float)[None])[0])
    exponent = np.float32(np.log(LEVEL) / np.log(np.clip(split.mean_level, 1e-3, LEVEL)))
    if method == "gamma":
        return lambda image: image**exponent

    def clahe(image: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
        lab = cv2.cvtColor(image**exponent, cv2.COLOR_RGB2LAB)
        # In 16 bits the limit of a small tile would be less than one pixel a level. Threads cannot share a CLAHE.
        lightness = np.round(lab[..., 0] * 2.55).astype(np.uint8)
        lab[..., 0] = cv2.createCLAHE(CLIP_LIMIT, TILES).apply(lightness) / np.float32(2.55)
        return np.clip(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), 0, 1)

    return clahe
