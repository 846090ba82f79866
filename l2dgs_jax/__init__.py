"""Low-light dynamic Gaussian splatting (L2DGS, CVPR 2026) in JAX: a dark video in, a well-lit 4D scene out."""

from l2dgs_jax.config import PRESETS, Config
from l2dgs_jax.data import load
from l2dgs_jax.errors import UserError
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.rendering import Renderer
from l2dgs_jax.runs import open_run
from l2dgs_jax.types import Camera, Gaussians, RasterOutput, RenderOutput, Scene, SceneParams

__all__ = [
    "PRESETS",
    "Camera",
    "Config",
    "Gaussians",
    "RasterOutput",
    "RenderOutput",
    "Renderer",
    "Scene",
    "SceneParams",
    "UserError",
    "load",
    "open_run",
    "rasterize",
]
