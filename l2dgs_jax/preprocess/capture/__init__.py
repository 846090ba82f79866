"""From a video or a folder of frames to a scene with camera poses."""

from l2dgs_jax.preprocess.capture.pipeline import CaptureConfig, prepare

__all__ = ["CaptureConfig", "prepare"]
