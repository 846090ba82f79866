"""Pictures and videos of a run."""

from l2dgs_jax.visualize.contact_sheet import contact_sheet
from l2dgs_jax.visualize.films import write_run_video, write_videos

__all__ = ["contact_sheet", "write_run_video", "write_videos"]
