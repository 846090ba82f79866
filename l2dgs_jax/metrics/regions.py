"""Scores of the regions of a frame against the ground truth."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Array, Bool, Float

from l2dgs_jax.metrics.measures import PSNR, SSIM, Maps, Measure, mean_score

Image = Float[Array, "H W C"] | Float[np.ndarray, "H W C"]
Mask = Bool[Array, "H W"] | Bool[np.ndarray, "H W"]
Score = dict[str, float | None]

Convention = Literal["nsff", "masked", "paper"]
BASIC = {"psnr": PSNR, "ssim": SSIM}
MOTION = ("dynamic", "static")  # the regions that a convention is about


def compare(
    prediction: Image,
    truth: Image,
    dynamic: Mask | None = None,
    valid: Mask | None = None,
    covisible: Mask | None = None,
    *,
    measures: Mapping[str, Measure] = BASIC,
    convention: Convention = "nsff",
) -> dict[str, Score]:
    """Score one frame, values in [0, 1].

    Args:
        prediction: rendered image.
        truth: ground truth.
        dynamic: which pixels show something that moves.
        valid: which pixels count; None for all. If some do not count, "overall" is scored by the convention "masked".
        covisible: which pixels enough training views have seen.
        measures: what to score, by name.
        convention: how "dynamic" and "static" are scored: "nsff", the mean of the whole frame's local values over the
            region (arXiv 2011.13084); "masked", after all but the region is set to black in both images, and SSIM from
            the region's pixels alone (DyCheck, arXiv 2210.13445); "paper", as "nsff" except for LPIPS, which is the
            whole frame's times the region's share of the area, as in the L2DGS paper.

    Returns:
        Scores by region: "overall"; with `dynamic` also "dynamic" and "static"; with `covisible` also "covisible",
        always by the convention "masked". Regions without pixels are left out; by the convention "paper", "dynamic" and
        "static" stay, because there LPIPS of no area is 0. A score is None if the region has too few pixels for it, and
        NaN if values are not finite. "area" is the region's share of the frame.

    Raises:
        ValueError: an image has integers, or a mask has other values than booleans.
    """
    prediction, truth = np.asarray(prediction), np.asarray(truth)
    for name, image in (("prediction", prediction), ("truth", truth)):
        if not np.issubdtype(image.dtype, np.floating):
            raise ValueError(f"{name}: an image of {image.dtype}; expected floating-point values in [0, 1]")
    for name, mask in (("dynamic", dynamic), ("valid", valid), ("covisible", covisible)):
        if mask is not None and mask.dtype != bool:
            raise ValueError(f"{name}: a mask of {mask.dtype}; expected booleans")
    masks = region_masks(prediction.shape[:2], dynamic, valid, covisible)
    counted = masks["overall"][..., None]
    prediction = np.where(np.isfinite(prediction), prediction, np.where(counted, prediction.dtype.type(np.nan), 0))
    truth = np.where(counted, truth.astype(prediction.dtype), prediction)
    finite = np.isfinite((prediction - truth)[masks["overall"]]).all()
    whole = {name: _maps(measure, prediction, truth, masks["overall"]) for name, measure in measures.items()}

    def by_area(name: str, region: str) -> bool:
        return convention == "paper" and region in MOTION and measures[name].spread

    def score(name: str, region: str) -> float:
        measure, mask = measures[name], masks[region]
        if by_area(name, region):
            return score(name, "overall") * mask.sum() / masks["overall"].sum()
        alone = convention == "masked" if region in MOTION else not (region == "overall" and mask.all())
        return _score_alone(measure, prediction, truth, mask) if alone else mean_score(whole[name], measure, mask)

    def told(name: str, region: str) -> float | None:
        if not masks[region].any() and not by_area(name, region):
            return None
        found = score(name, region)
        return known(found) if finite else found

    kept = MOTION if convention == "paper" and masks["overall"].any() else ()
    shown = [region for region, mask in masks.items() if mask.any() or region in kept]
    areas = {region: float(masks[region].mean()) if masks[region].any() else None for region in shown}
    return {region: {name: told(name, region) for name in measures} | {"area": areas[region]} for region in shown}


def region_masks(
    shape: tuple[int, int], dynamic: Mask | None, valid: Mask | None, covisible: Mask | None
) -> dict[str, Bool[np.ndarray, "H W"]]:
    """Masks of the regions that `compare` scores; see there for the arguments."""
    counted = np.ones(shape, bool) if valid is None else np.asarray(valid)
    masks = {"overall": counted}
    if dynamic is not None:
        masks |= {"dynamic": counted & np.asarray(dynamic), "static": counted & ~np.asarray(dynamic)}
    if covisible is not None:
        masks["covisible"] = counted & np.asarray(covisible)
    return masks


def clipped(image: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """Values clipped to [0, 1]; infinite ones become NaN, so that they are not taken for white or black."""
    return np.clip(np.where(np.isfinite(image), image, np.nan), 0, 1)


def summarise(frames: Sequence[Mapping[str, Score]]) -> dict[str, Score]:
    """Means per region and score over the frames that have the score; None if no frame has it or if one is NaN."""
    summary: dict[str, Score] = {}
    for region in dict.fromkeys(region for frame in frames for region in frame):
        scored = [frame[region] for frame in frames if region in frame]
        had = {key: [value for score in scored if (value := score[key]) is not None] for key in scored[0]}
        summary[region] = {key: known(float(np.mean(values))) if values else None for key, values in had.items()}
    return summary


def _maps(
    measure: Measure, prediction: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], counted: np.ndarray
) -> Maps:
    """Local values of the whole frame, from the pixels that count alone if the measure has a form for that."""
    if measure.partial and not counted.all():
        return measure.partial(prediction, truth, counted)
    return measure.maps(prediction, truth)


def _score_alone(
    measure: Measure, prediction: Float[np.ndarray, "H W C"], truth: Float[np.ndarray, "H W C"], mask: np.ndarray
) -> float:
    if measure.masked:
        return measure.masked(prediction, truth, mask)
    seen = mask[..., None]
    return mean_score(measure.maps(prediction * seen, truth * seen), measure, mask)


def known(score: float) -> float | None:
    """A score, or None for NaN, which JSON lacks."""
    return None if np.isnan(score) else score
