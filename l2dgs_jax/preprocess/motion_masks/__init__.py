"""Masks of what moves in a video with known camera poses."""

from l2dgs_jax.preprocess.motion_masks.scene_masks import as_taken, compute_masks, preview, write_masks

__all__ = ["as_taken", "compute_masks", "preview", "write_masks"]
