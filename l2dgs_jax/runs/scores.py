"""How well the views of a run match the input and, where known, the truth."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Float16, Shaped

from l2dgs_jax import metrics
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, pixel_mean, stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics import RegionScore
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.views import get_split, views


def evaluate(run: Run, split_name: str = "test") -> dict:
    """Render every view of a split and compare it with the input and, where the scene has it, with the well-lit truth.

    PSNR (dB) and SSIM are means over the frames. A region's PSNR is that of its own pixels, its SSIM the mean of the
    whole frame's SSIM map over them (as NSFF, arXiv 2011.13084); a frame counts where it shows the region. Pixels that
    are not valid are left out everywhere.

    Returns:
        What can be written as JSON:

        * "split", "stage", "step", "gaussians", "frames": what was scored;
        * "lowlight_gain": "none", or if the camera's exposure drifts "own": estimates of the dark input are compared
          with it after the gain that suits each of them best;
        * "lowlight": "psnr" and "ssim" of the estimate of the dark input against that input, and with masks
          "lowlight_regions", the same for "dynamic" and "static", and "mask_area", the dynamic part of all pixels;
          where the scene says what the training views have seen, "covisible" in "lowlight_regions", as DyCheck
          (arXiv 2210.13445) scores it. A scene learned from brightened frames (`Config.enhance`) has none of these:
          it makes no estimate of the dark input;
        * with truth "welllit": for "overall" and each of those regions the "psnr" and "ssim" of the
          well-lit image as rendered, and "psnr_gain" and "ssim_gain" after it was multiplied by "gain" and clipped to
          [0, 1]: the one factor for all frames that, clipping included, leaves the least mean squared error;
        * with truth "dark_frame_gain": "gain", "psnr_gain" and "ssim_gain" of the dark input times its own best factor,
          which is what knowing the exposure alone would score.

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
            lowlight.append(_compare(exposed(estimate, index), split.images, split, index))
            yield np.asarray(output.images.welllit, np.float16)

    welllit = stacked(relit(), split.images.shape, np.float16, in_file=isinstance(split.images, MappedArray))
    result: dict = {
        "split": split_name,
        "stage": "fine" if run.moving else "coarse",
        "step": int(run.state.step),
        "gaussians": int(run.state.scene.alive.sum()),
        "frames": len(split.names),
    }
    if run.config.enhance == "none":
        scores = metrics.summarise(lowlight)
        result |= {"lowlight_gain": "own" if drifting else "none", "lowlight": scores.pop("overall")}
        if scores:
            result["lowlight_regions"] = scores
    if split.masks is not None:
        result["mask_area"] = float(pixel_mean(split.masks, split.valid))
    if split.welllit is not None:
        plain, gained, gain = _with_gain(welllit, split.welllit, split)
        result |= {"welllit": {region: plain[region] | gained[region] for region in plain}, "gain": gain}
        whole = dataclasses.replace(split, masks=None, covisible=None)
        _, gained, gain = _with_gain(split.images, split.welllit, whole)
        result["dark_frame_gain"] = {"gain": gain} | gained["overall"]
    return result


def table(result: dict) -> str:
    """The scores that `evaluate` returns, as aligned text."""
    rows = []
    if "lowlight" in result:
        rows.append(("low light" if result["lowlight_gain"] == "none" else "low light x gain", result["lowlight"]))
    rows += [(f"  {region}", scores) for region, scores in result.get("lowlight_regions", {}).items()]
    for region, scores in result.get("welllit", {}).items():
        rows.append(("well-lit" if region == "overall" else f"  {region}", scores))
    if "dark_frame_gain" in result:
        rows.append(("dark frame x gain", result["dark_frame_gain"]))
    lines = [f"{result['frames']} {result['split']} views, {result['stage']} stage, step {result['step']}"]
    with_gain = f"{'PSNR, gain':>13}{'SSIM, gain':>13}" if "gain" in result else ""
    lines.append(f"{'':18}{'PSNR':>8}{'SSIM':>8}{with_gain}")
    formats = (("psnr", 8, "8.2f"), ("ssim", 8, "8.3f"), ("psnr_gain", 13, "13.2f"), ("ssim_gain", 13, "13.3f"))
    for name, scores in rows:
        cells = [format(scores[key], form) if key in scores else " " * width for key, width, form in formats]
        lines.append(f"{name:18}{''.join(cells)}".rstrip())
    if "gain" not in result:
        lines.append("the scene has no well-lit truth to compare with")
    else:
        lines.append(f"gain {result['gain']:.3f}, of the dark frame {result['dark_frame_gain']['gain']:.3f}")
    if "mask_area" in result:
        lines.append(f"dynamic region: {100 * result['mask_area']:.1f} % of the pixels")
    return "\n".join(lines)


def _with_gain(
    predictions: Float[np.ndarray, "F H W 3"],
    truths: Float[np.ndarray, "F H W 3"],
    split: Split,
) -> tuple[dict, dict, float]:
    """Scores per region without and with the one best gain, and that gain."""
    plain = [_compare(p, truths, split, i) for i, p in enumerate(predictions)]
    gain = metrics.best_gain(_counted(p, truths, split, i) for i, p in enumerate(predictions))
    gained = [_compare(gain * p.astype(np.float32), truths, split, i) for i, p in enumerate(predictions)]
    after = metrics.summarise(gained)
    renamed = {region: {f"{key}_gain": value for key, value in means.items()} for region, means in after.items()}
    return metrics.summarise(plain), renamed, gain


def _counted(
    prediction: Float[np.ndarray, "H W 3"], truths: Float[np.ndarray, "F H W 3"], split: Split, index: int
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Prediction and truth of the frame `index` where its pixels count."""
    counted = slice(None) if split.valid is None else split.valid[index]
    return prediction[counted], truths[index][counted]


def _compare(
    prediction: Shaped[Any, "H W 3"],
    truths: Float[np.ndarray, "F H W 3"],
    split: Split,
    index: int,
) -> dict[str, RegionScore]:
    """Score a prediction, clipped to [0, 1], of the frame `index`, in the regions that the split marks."""
    clipped = np.clip(np.asarray(prediction, np.float32), 0, 1)
    masks = (None if x is None else x[index] for x in (split.masks, split.valid, split.covisible))
    return metrics.compare(clipped, truths[index].astype(np.float32), *masks)
