"""Low-light twins of well-lit scenes."""

from l2dgs_jax.preprocess.lowlight.simulation import DarkeningConfig, contact_sheet, darken, mean_report

__all__ = ["DarkeningConfig", "contact_sheet", "darken", "mean_report"]
