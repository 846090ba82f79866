"""Geometry of cameras, and paths for them."""

from l2dgs_jax.cameras.geometry import camera_centres, camera_extent, median_depth, reframe, resize, select_camera

__all__ = ["camera_centres", "camera_extent", "median_depth", "reframe", "resize", "select_camera"]
