"""From a video or a folder of frames to frames with poses."""

from l2dgs_jax.preprocess.capture.pipeline import CaptureConfig, prepare

__all__ = ["CaptureConfig", "prepare"]
