"""Pictures and videos of a run."""

from l2dgs_jax.visualize.contact_sheet import contact_sheet
from l2dgs_jax.visualize.video import write_run_video, write_video

__all__ = ["contact_sheet", "write_run_video", "write_video"]
