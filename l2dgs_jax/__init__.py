"""Low-light dynamic Gaussian splatting (L2DGS, CVPR 2026) in JAX: a dark video in, a well-lit 4D scene out."""

from importlib.metadata import PackageNotFoundError, version

from l2dgs_jax.cameras import resize
from l2dgs_jax.config import PRESETS, Config, DensityConfig, LossConfig, ModelConfig, OptimConfig
from l2dgs_jax.data import Dataset, Split, load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.runs import Checkpoint, Run, fit, open_run, save_run
from l2dgs_jax.training import DivergedError, Progress, StepReport, TrainState
from l2dgs_jax.types import Camera, Decomposition, Gaussians, RasterOutput, RenderOutput, Scene, SceneParams

try:
    __version__ = version("l2dgs-jax")
except PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "0"

__all__ = [
    "PRESETS",
    "Camera",
    "Checkpoint",
    "Config",
    "Dataset",
    "Decomposition",
    "DensityConfig",
    "DivergedError",
    "Gaussians",
    "LossConfig",
    "ModelConfig",
    "OptimConfig",
    "Progress",
    "RasterOutput",
    "RenderOutput",
    "Renderer",
    "Run",
    "Scene",
    "SceneParams",
    "Split",
    "StepReport",
    "TrainState",
    "UserError",
    "__version__",
    "fit",
    "load_dataset",
    "open_run",
    "rasterize",
    "resize",
    "save_run",
    "use_kernels",
]
