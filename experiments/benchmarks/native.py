"""The machine's limit for blending: a C loop over the same lists, compiled for this processor, on all cores."""

import ctypes
import subprocess
import tempfile
from functools import partial
from pathlib import Path

import jax
import numpy as np

from l2dgs_jax.kernels.tiles import TILE_SIZE, TileLists, grid
from l2dgs_jax.rasterizer.projection import project
from l2dgs_jax.rasterizer.tile_lists import footprints, intersect, pairs_needed

FLAGS = ("-Ofast", "-march=native", "-mprefer-vector-width=512", "-fopenmp", "-shared", "-fPIC")


class NativeBlend:
    """Forward and backward pass of one scene as methods without arguments, for timing.

    Raises:
        RuntimeError: gcc is missing or cannot compile the loop.
    """

    def __init__(self, arrays: dict[str, np.ndarray], width: int, height: int):
        means2d, conics, lists = _lists(arrays, width, height)
        channels = arrays["features"].shape[1]
        self._library = _build(channels)
        tiles, columns = len(lists.starts), grid(width, height)[0]
        self.pairs = int(lists.stops[-1])
        geometry = np.concatenate([means2d, conics, arrays["opacities"][:, None]], axis=-1)
        float32 = partial(np.ascontiguousarray, dtype=np.float32)
        image = lambda: np.zeros((tiles, channels, TILE_SIZE * TILE_SIZE), np.float32)
        self._inputs = (
            float32(geometry),
            float32(arrays["features"]),
            np.ascontiguousarray(lists.gaussians, np.int32),
            np.append(lists.starts, self.pairs).astype(np.int32),
        )
        self._output, self._transmittance = image(), np.zeros((tiles, TILE_SIZE * TILE_SIZE), np.float32)
        self._cotangent = float32(np.random.default_rng(0).normal(size=self._output.shape))
        self._gradient = np.zeros((self.pairs, 6 + channels), np.float32)
        self._shape = (tiles, columns)

    def forward(self) -> None:
        """Blend every tile."""
        self._library.fwd(*_pointers(self._inputs), *self._shape, *_pointers((self._output, self._transmittance)))

    def backward(self) -> None:
        """Gradients of every (Gaussian, tile) pair, for a fixed random cotangent; `forward` must be called first."""
        outputs = (self._output, self._transmittance, self._cotangent, self._gradient)
        self._library.bwd(*_pointers(self._inputs), *self._shape, *_pointers(outputs))


def _build(channels: int) -> ctypes.CDLL:
    library = Path(tempfile.mkdtemp()) / "blend.so"
    source = Path(__file__).with_name("native_blend.c")
    command = ["gcc", *FLAGS, f"-DC={channels}", str(source), "-o", str(library), "-lmvec", "-lm"]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise RuntimeError(f"gcc could not build {source.name}; the native limit needs it") from error
    return ctypes.CDLL(str(library))


def _lists(arrays: dict[str, np.ndarray], width: int, height: int) -> tuple[np.ndarray, np.ndarray, TileLists]:
    geometry = [arrays[name] for name in ("means", "quats", "scales", "viewmat", "K")]
    projected = jax.tree.map(lambda x: x[None], project(*map(jax.numpy.asarray, geometry), width=width, height=height))
    boxes = footprints(projected, jax.numpy.asarray(arrays["opacities"])[None], width, height)
    lists = intersect(projected, boxes, width, height, int(pairs_needed(boxes)))
    return np.asarray(projected.means2d[0]), np.asarray(projected.conics[0]), jax.tree.map(np.asarray, lists)


def _pointers(arrays: tuple[np.ndarray, ...]) -> list[ctypes.c_void_p]:
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
