"""How well the views of a run match the input and, where known, the truth."""

import dataclasses
from collections.abc import Iterator, Mapping

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

_WELLLIT = metrics.BASIC | {"ssim_3dgs": metrics.SSIM_3DGS, "ms_ssim": metrics.MS_SSIM, "flip": metrics.FLIP}


def evaluate(
    run: Run,
    split_name: str = "test",
    *,
    lpips: Mapping[Network, Lpips] | None = None,
    convention: Convention = "nsff",
) -> dict:
    """Render every view of a split and compare it with the input and, where the scene has it, with the well-lit truth.

    Scores are means over the frames; docs/metrics.md defines them. A frame counts where it shows a region, and pixels
    that are not valid are left out everywhere.

    Args:
        run: the run.
        split_name: "test" or "train".
        lpips: weights of the networks that LPIPS is to be computed with.
        convention: how regions are scored, see `metrics.compare`.

    Returns:
        What can be written as JSON; None is a score that cannot be had, "area" a region's part of the pixels of the
        frames that show it:

        * "split", "stage", "step", "gaussians", "frames": what was scored;
        * "region_convention": how;
        * "lowlight_gain": "none", or if the camera's exposure drifts "own": estimates of the dark input are compared
          with it after the gain that suits each of them best;
        * "lowlight": "psnr" and "ssim" of the estimate of the dark input against that input, and with masks
          "lowlight_regions", the same for "dynamic" and "static", and "mask_area", the dynamic part of all pixels;
          where the scene says what the training views have seen, "covisible" in "lowlight_regions", as DyCheck
          (arXiv 2210.13445) scores it. A scene learned from brightened frames (`Config.enhance`) has none of these:
          it makes no estimate of the dark input;
        * with truth "welllit": for "overall" and each of those regions "psnr", "ssim", "ssim_3dgs", "ms_ssim", "flip",
          "lpips_alex" and "lpips_vgg" of the well-lit image as rendered, and the same with "_gain" after it was
          multiplied by "gain" and clipped to [0, 1]: the one factor for all frames that, clipping included, leaves the
          least mean squared error;
        * with truth "dark_frame_gain": "gain", "psnr_gain" and "ssim_gain" of the dark input times its own best factor,
          which is what knowing the exposure alone would score;
        * "temporal": how steady the well-lit views are, see `steadiness`.

    Raises:
        UserError: the split has no views, or they have no valid pixel.
    """
    split = get_split(run, split_name)
    if split.valid is not None and not any(frame.any() for frame in split.valid):
        raise UserError(f"{run.name}: no pixel of its scene's {split_name} views is valid; expected some to score")
    drifting = run.state.scene.params.exposures is not None
    lowlight = []

    def exposed(estimate: Float[np.ndarray, "H W 3"], index: int) -> Float[np.ndarray, "H W 3"]:
        """As its frame's camera exposed it, if exposures differ: nobody has told that of frames not trained on."""
        if not drifting:
            return estimate
        return metrics.best_gain([_counted(estimate, split.images, split, index)]) * estimate

    def relit() -> Iterator[Float16[np.ndarray, "H W 3"]]:
        """The well-lit views, as compact as the data set's own; the low-light ones are scored on the way."""
        for index, output in enumerate(views(run, split.cameras)):
            estimate = np.asarray(output.images.lowlight)
            lowlight.append(_compare(exposed(estimate, index), split.images, split, index, metrics.BASIC, convention))
            yield np.asarray(output.images.welllit, np.float16)

    welllit = stacked(relit(), split.images.shape, np.float16, in_file=isinstance(split.images, MappedArray))
    result: dict = {
        "split": split_name,
        "stage": "fine" if run.moving else "coarse",
        "step": int(run.state.step),
        "gaussians": int(run.state.scene.alive.sum()),
        "frames": len(split.names),
        "region_convention": convention,
    }
    if run.config.enhance == "none":
        scores = metrics.summarise(lowlight)
        result |= {"lowlight_gain": "own" if drifting else "none", "lowlight": scores.pop("overall")}
        if scores:
            result["lowlight_regions"] = scores
    if split.masks is not None:
        result["mask_area"] = float(pixel_mean(split.masks, split.valid))
    if split.welllit is not None:
        networks = {f"lpips_{name}": metrics.lpips_measure(name, (lpips or {}).get(name)) for name in metrics.NETWORKS}
        plain, gained, gain = _with_gain(welllit, split.welllit, split, _WELLLIT | networks, convention)
        result |= {"welllit": {region: plain[region] | gained[region] for region in plain}, "gain": gain}
        whole = dataclasses.replace(split, masks=None, covisible=None)
        _, dark, dark_gain = _with_gain(split.images, split.welllit, whole, metrics.BASIC, convention)
        result["dark_frame_gain"] = {"gain": dark_gain} | dark["overall"]
    result["temporal"] = steadiness(welllit, split, result.get("gain"))
    return result


def _with_gain(
    predictions: Float[np.ndarray, "F H W 3"],
    truths: Float[np.ndarray, "F H W 3"],
    split: Split,
    measures: Mapping[str, Measure],
    convention: Convention,
) -> tuple[dict[str, Score], dict[str, Score], float]:
    """Scores per region without and with the one best gain, and that gain."""

    def scores(factor: float) -> dict[str, Score]:
        def compare(index: int) -> dict[str, Score]:
            prediction = np.float32(factor) * predictions[index].astype(np.float32)
            return _compare(prediction, truths, split, index, measures, convention)

        return metrics.summarise(list(prefetch(compare, range(len(predictions)))))

    gain = metrics.best_gain(_counted(p, truths, split, i) for i, p in enumerate(predictions))
    gained = {region: {f"{name}_gain": score[name] for name in measures} for region, score in scores(gain).items()}
    return scores(1.0), gained, gain


def _counted(
    prediction: Float[np.ndarray, "H W 3"], truths: Float[np.ndarray, "F H W 3"], split: Split, index: int
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Prediction and truth of the frame `index` where its pixels count."""
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
    """Score a prediction, clipped to [0, 1], of the frame `index`, in the regions that the split marks."""
    clipped = np.clip(np.asarray(prediction, np.float32), 0, 1)
    masks = (None if x is None else x[index] for x in (split.masks, split.valid, split.covisible))
    return metrics.compare(clipped, truths[index].astype(np.float32), *masks, measures=measures, convention=convention)
