"""All settings, the named presets, and access to settings by their dotted names."""

from l2dgs_jax.config.overrides import from_dict
from l2dgs_jax.config.presets import PRESETS
from l2dgs_jax.config.settings import (
    EXECUTION,
    Config,
    DensityConfig,
    Enhancement,
    Layout,
    LayoutName,
    LossConfig,
    ModelConfig,
    OptimConfig,
    to_dict,
)

__all__ = [
    "EXECUTION",
    "PRESETS",
    "Config",
    "DensityConfig",
    "Enhancement",
    "Layout",
    "LayoutName",
    "LossConfig",
    "ModelConfig",
    "OptimConfig",
    "from_dict",
    "to_dict",
]
