"""Geometry of cameras and of the ground, matches between views, and camera paths."""

from l2dgs_jax.cameras.geometry import camera_centres, camera_extent, median_depth, reframe, resize, select_camera

__all__ = ["camera_centres", "camera_extent", "median_depth", "reframe", "resize", "select_camera"]
