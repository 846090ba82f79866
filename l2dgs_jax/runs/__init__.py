"""Runs: trained scenes in memory, and their folders on disk."""

from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.fitting import fit
from l2dgs_jax.runs.folder import (
    CHECKPOINT,
    COARSE,
    CONTACT_SHEET,
    METRICS,
    SETTINGS,
    VIDEO,
    check_scene,
    follow_scene,
    is_needed,
    last_checkpoint,
    open_run,
    read_metrics,
    read_settings,
    save_run,
    write_settings,
)
from l2dgs_jax.runs.recorder import Recorder
from l2dgs_jax.runs.run import Run

__all__ = [
    "CHECKPOINT",
    "COARSE",
    "CONTACT_SHEET",
    "METRICS",
    "SETTINGS",
    "VIDEO",
    "Checkpoint",
    "Recorder",
    "Run",
    "check_scene",
    "fit",
    "follow_scene",
    "is_needed",
    "last_checkpoint",
    "open_run",
    "read_metrics",
    "read_settings",
    "save_run",
    "write_settings",
]
