"""Temporal stability of the well-lit views of a run."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from l2dgs_jax import metrics
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.metrics import Score
from l2dgs_jax.training.flows import neighbour_flows


def steadiness(welllit: Float[np.ndarray, "F H W 3"], split: Split, gain: float | None) -> dict:
    """The warping error (arXiv 1808.00449) between each view and the one of the next instant whose camera is nearest.

    Only pixels count at which forward and backward optical flow agree, and only pairs of views that show mostly the
    same.

    Args:
        welllit: the well-lit images of the split's views.
        split: the views; flow is computed on their ground truth, or without it on their dark input.
        gain: factor on the images, before they are clipped to [0, 1], for a second score; None without ground truth,
            NaN if images are not finite.

    Returns:
        Scores that can be written as JSON:

        * "flow": what it was computed on, "truth" or "input";
        * "pairs": how many pairs of views were compared;
        * "regions": for "overall", "dynamic", "static" and "covisible", as far as the split has masks of them:
          "warping_error" of the images; "area", the share of the pixels that were compared; and given a gain
          "warping_error_gain" of the images times the gain and "warping_error_truth" of the ground truth, which is due
          to errors of the flow and changes of light. A score is None if an image is not finite where it counts.
    """
    videos = {"warping_error": (welllit, 1.0)}
    source = split
    if split.welllit is not None and gain is not None:
        videos |= {"warping_error_gain": (welllit, gain), "warping_error_truth": (split.welllit, 1.0)}
        source = dataclasses.replace(split, images=split.welllit)
    flows, nothing = neighbour_flows(source), np.broadcast_to(np.float16(0), welllit.shape)

    def shown(video: Float[np.ndarray, "F H W 3"], index: int, factor: float) -> Float[np.ndarray, "H W 3"]:
        image = metrics.clipped(np.float32(factor) * video[index].astype(np.float32))
        return image if split.valid is None else np.where(split.valid[index][..., None], image, np.float32(np.nan))

    def score(frame: int, after: int) -> dict[str, Score]:
        flow = flows.displacements[frame, 0]
        errors = {
            name: metrics.warping_error_map(shown(video, frame, factor), shown(video, after, factor), flow)
            for name, (video, factor) in videos.items()
        }
        known = np.isfinite(metrics.warping_error_map(shown(nothing, frame, 1.0), shown(nothing, after, 1.0), flow))
        marks = (None if x is None else x[frame] for x in (split.masks, split.valid, split.covisible))
        return {
            region: {name: _mean(error, mask & known) for name, error in errors.items()}
            | {"area": float((mask & known).mean())}
            for region, mask in metrics.region_masks(flow.shape[:2], *marks).items()
            if mask.any()
        }

    pairs = [(frame, after) for frame, after in enumerate(flows.following.tolist()) if after != frame]
    return {
        "flow": "input" if source is split else "truth",
        "pairs": len(pairs),
        "regions": metrics.summarise([score(frame, after) for frame, after in pairs]),
    }


def _mean(values: Float[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"]) -> float | None:
    return float(values[mask].mean()) if mask.any() else None
