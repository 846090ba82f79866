"""How well a run's views match the input and, where known, the ground truth."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Float16

from l2dgs_jax import metrics
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, pixel_mean, stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics import Convention, Lpips, Measure, Network, Score
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.steadiness import steadiness
from l2dgs_jax.runs.views import get_split, views
from l2dgs_jax.runtime.prefetch import prefetch

T = TypeVar("T")

_WELLLIT = metrics.BASIC | {"ssim_3dgs": metrics.SSIM_3DGS, "ms_ssim": metrics.MS_SSIM, "flip": metrics.FLIP}


def evaluate(
    run: Run,
    split_name: str = "test",
    *,
    lpips: Mapping[Network, Lpips] | None = None,
    convention: Convention = "nsff",
) -> dict:
    """Render every view of a split and compare it with the input and, if the scene has it, the well-lit ground truth.

    Scores are means over the frames; docs/metrics.md defines them. A region's means are over the frames that show
    enough of it for the score, and pixels that are not valid are left out everywhere.

    Args:
        run: the run.
        split_name: "test" or "train".
        lpips: weights of the networks to compute LPIPS with.
        convention: how regions are scored, see `metrics.compare`.

    Returns:
        Scores that can be written as JSON; None if a score cannot be computed, for example because a rendered frame
        has values that are not finite, for which there is a warning. "area" is a region's share of the pixels of the
        frames that show it.

        * "split", "stage", "step", "gaussians", "frames": what was scored;
        * "region_convention": how regions were scored;
        * "lowlight_gain": "own" if the camera's exposure drifts, "none" otherwise: with "own", each estimate of a dark
          frame is compared after the gain that suits it best;
        * "lowlight": "psnr" and "ssim" of the estimate of the dark input against that input; with masks also
          "lowlight_regions", the same for "dynamic" and "static", and "mask_area", the dynamic share of all pixels;
          with covisibility masks also "covisible" in "lowlight_regions", scored as in DyCheck (arXiv 2210.13445). A
          scene learned from brightened frames (`Config.enhance`) has none of these, because it makes no estimate of the
          dark input;
        * with ground truth, "welllit": for "overall" and each of those regions "psnr", "ssim", "ssim_3dgs", "ms_ssim",
          "flip", "lpips_alex" and "lpips_vgg" of the well-lit image as rendered, and the same with "_gain" after it was
          multiplied by "gain" and clipped to [0, 1]. "gain" is the factor, common to all frames, that leaves the least
          mean squared error after clipping;
        * with ground truth, "dark_frame_gain": "gain", "psnr_gain" and "ssim_gain" of the dark input times its own best
          factor: what knowing only the exposure would score;
        * "temporal": temporal stability of the well-lit views, see `steadiness`.

    Raises:
        UserError: the split has no views, or they have no valid pixel.
    """
    split = get_split(run, split_name)
    if split.valid is not None and not any(frame.any() for frame in split.valid):
        raise UserError(f"{run.name}: no pixel of its scene's {split_name} views is valid; expected some to score")
    drifting = run.state.scene.params.exposures is not None

    def exposed(estimate: Float[np.ndarray, "H W 3"], index: int) -> Float[np.ndarray, "H W 3"]:
        """The estimate at its frame's exposure; where exposures drift it is fitted, as held-out frames have no gain."""
        if not drifting:
            return estimate
        return metrics.best_gain([_counted(estimate, split.images, split, index)]) * estimate

    def drawn() -> Iterator[tuple[Float16[np.ndarray, "H W 3"], _Lowlight]]:
        """The well-lit views as half floats, like the data set's, and the scores of the low-light ones."""
        for index, output in enumerate(views(run, split.cameras)):
            images = output.images
            pixels = (_counted(np.asarray(x), split.images, split, index)[0] for x in (images.welllit, images.lowlight))
            finite = all(np.isfinite(values).all() for values in pixels)
            estimate = exposed(np.asarray(images.lowlight), index)
            scores = _compare(estimate, split.images, split, index, metrics.BASIC, convention)
            yield np.asarray(images.welllit, np.float16), _Lowlight(scores, finite)

    welllit, lowlight = _apart(drawn(), split)
    broken = [name for name, view in zip(split.names, lowlight, strict=True) if not view.finite]
    if broken:
        frames = ", ".join(broken)
        warnings.warn(f"{run.name}: not finite, and without a score: {split_name} views {frames}", stacklevel=2)
    result: dict = {
        "split": split_name,
        "stage": "fine" if run.moving else "coarse",
        "step": int(run.state.step),
        "gaussians": int(run.state.scene.alive.sum()),
        "frames": len(split.names),
        "region_convention": convention,
    }
    if run.config.enhance == "none":
        scores = metrics.summarise([view.scores for view in lowlight])
        result |= {"lowlight_gain": "own" if drifting else "none", "lowlight": scores.pop("overall")}
        if scores:
            result["lowlight_regions"] = scores
    if split.masks is not None:
        result["mask_area"] = float(pixel_mean(split.masks, split.valid))
    gain = None
    if split.welllit is not None:
        networks = {f"lpips_{name}": metrics.lpips_measure(name, (lpips or {}).get(name)) for name in metrics.NETWORKS}
        gain = _best_gain(welllit, split.welllit, split)
        compared = partial(_scores, welllit, split.welllit, split, _WELLLIT | networks, convention)
        plain, gained = compared(1.0), _named_gain(compared(gain))
        result |= {"welllit": {region: plain[region] | gained[region] for region in plain}, "gain": metrics.known(gain)}
        whole = dataclasses.replace(split, masks=None, covisible=None)
        dark_gain = _best_gain(split.images, split.welllit, split)
        dark = _scores(split.images, split.welllit, whole, metrics.BASIC, convention, dark_gain)
        result["dark_frame_gain"] = {"gain": dark_gain} | _named_gain(dark)["overall"]
    result["temporal"] = steadiness(welllit, split, gain)
    return result


class _Lowlight(NamedTuple):
    """The scores of a view's low-light image, and whether all values of both of its images are finite."""

    scores: dict[str, Score]
    finite: bool


def _apart(
    pairs: Iterator[tuple[Float16[np.ndarray, "H W 3"], T]], split: Split
) -> tuple[Float16[np.ndarray, "F H W 3"], list[T]]:
    """The images as one array, in a file if the split's images are in one, and the other items as a list."""
    others: list[T] = []

    def images() -> Iterator[Float16[np.ndarray, "H W 3"]]:
        for image, other in pairs:
            others.append(other)
            yield image

    return stacked(images(), split.images.shape, np.float16, in_file=isinstance(split.images, MappedArray)), others


def _best_gain(predictions: Float[np.ndarray, "F H W 3"], truths: Float[np.ndarray, "F H W 3"], split: Split) -> float:
    return metrics.best_gain(_counted(p, truths, split, i) for i, p in enumerate(predictions))


def _scores(
    predictions: Float[np.ndarray, "F H W 3"],
    truths: Float[np.ndarray, "F H W 3"],
    split: Split,
    measures: Mapping[str, Measure],
    convention: Convention,
    factor: float,
) -> dict[str, Score]:
    """Mean scores per region of predictions multiplied by a factor."""

    def compare(index: int) -> dict[str, Score]:
        prediction = np.float32(factor) * predictions[index].astype(np.float32)
        return _compare(prediction, truths, split, index, measures, convention)

    return metrics.summarise(list(prefetch(compare, range(len(predictions)))))


def _named_gain(regions: dict[str, Score]) -> dict[str, Score]:
    """The same scores with "_gain" appended to their names; areas are left out."""
    return {
        region: {f"{name}_gain": value for name, value in scores.items() if name != "area"}
        for region, scores in regions.items()
    }


def _counted(
    prediction: Float[np.ndarray, "H W 3"], truths: Float[np.ndarray, "F H W 3"], split: Split, index: int
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Prediction and ground truth of the frame `index`, restricted to its valid pixels."""
    counted = slice(None) if split.valid is None else split.valid[index]
    return prediction[counted], truths[index][counted]


def _compare(
    prediction: Float[np.ndarray, "H W 3"],
    truths: Float[np.ndarray, "F H W 3"],
    split: Split,
    index: int,
    measures: Mapping[str, Measure],
    convention: Convention,
) -> dict[str, Score]:
    """Score a prediction of the frame `index`, clipped to [0, 1], in the regions that the split has masks of."""
    clipped = metrics.clipped(np.asarray(prediction, np.float32))
    masks = (None if x is None else x[index] for x in (split.masks, split.valid, split.covisible))
    return metrics.compare(clipped, truths[index].astype(np.float32), *masks, measures=measures, convention=convention)
