"""From a video or a folder of frames to a scene: frames, brighter copies, masks, structure from motion, report."""

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from tqdm import tqdm

from l2dgs_jax.data import images
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.capture import brighten, frames, motion, report, structure
from l2dgs_jax.preprocess.capture.frames import Candidate
from l2dgs_jax.preprocess.capture.structure import CameraModel, Workplace
from l2dgs_jax.runtime.files import expect_new, new_folder, replacing, write_json

FEWEST_FRAMES = 5
FEWEST_REGISTERED = 0.5  # share of the frames that must get a pose
ADVICE = (
    "film more slowly, with more light and more overlap, and walk instead of turning on the spot; "
    "or try more --frames, or another --camera-model"
)


@dataclass(frozen=True)
class CaptureConfig:
    """How a video becomes a scene.

    Attributes:
        frames: largest number of frames to take, evenly spaced and sharp.
        camera_model: COLMAP's name of the camera model that all frames share.
        threads: CPU threads for structure from motion; 0 for all. Only with 1 are results reproducible.
    """

    frames: int = 120
    camera_model: CameraModel = "SIMPLE_RADIAL"
    threads: int = 0


Curve = Callable[[Float32[np.ndarray, "H W 3"], brighten.Tone], UInt8[np.ndarray, "H W"]]


def prepare(source: Path, output: Path, cfg: CaptureConfig, curve: Curve = brighten.brighten) -> dict:
    """Make the scene: frames, COLMAP's model, `report.json` and `contact_sheet.png`.

    Intermediate results are kept in a folder beside `output` whose name ends in `.partial`. The next call with the same
    source and settings continues from there; the folder is removed once the scene is complete.

    Args:
        source: a video, or a folder of frames with numbered names.
        output: folder to create.
        cfg: settings.
        curve: makes the brighter copies that features and flow are found in. Intermediate results do not record which
            curve they were made with, so another curve needs another `output`.

    Returns:
        The report.

    Raises:
        UserError: a setting or `output` is invalid, the source cannot be read, the camera does not move, or too few
            frames get a pose; in the last case the `.partial` folder holds a contact sheet that shows why.
    """
    if cfg.frames < FEWEST_FRAMES:
        raise UserError(f"--frames {cfg.frames}: expected at least {FEWEST_FRAMES}")
    if cfg.threads < 0:
        raise UserError(f"--threads {cfg.threads}: expected 0, for all, or a number of threads")
    structure.pycolmap()
    if not source.exists():
        raise UserError(f"{source}: no such file or folder; expected a video or a folder of frames")
    expect_new(output)
    work = _open_work(source, output, cfg)
    threads = cfg.threads or os.cpu_count() or 1
    workplace = Workplace(
        work / "frames", work / "copies", work / "masks", work / "database.db", work / "models", threads
    )
    for made in (workplace.frames, workplace.copies, workplace.masks):
        made.mkdir(exist_ok=True)
    try:
        candidates = _scan(source, work)
    except UserError:
        shutil.rmtree(work)  # there is nothing to go on with
        raise
    chosen = frames.sample([candidate.sharpness for candidate in candidates], cfg.frames)
    frames.extract(source, candidates, chosen, workplace.frames)
    names = [candidates[i].name for i in chosen]
    tone, copies = _brighten(workplace, names, curve)
    shift = motion.camera_shift(copies)
    if shift < motion.STILL_BELOW:
        raise UserError(
            f"{source}: the camera stands still (the picture shifts by {shift:.1f} of {copies[0].shape[1]} "
            "pixels); expected a camera that moves through the scene, as depth shows in parallax only"
        )
    moving = _mask(workplace, names, copies)
    structure.find_features(workplace, names, cfg.camera_model)
    structure.match_features(workplace, names)
    pairs, with_parallax = structure.count_pairs(workplace)
    if pairs and not with_parallax:  # only if there are none: scenes of little depth have few, which suffice
        raise UserError(
            f"{source}: 0 of {pairs} pairs of frames show parallax, so the camera only turns or "
            f"sees a flat surface; expected a camera that moves through the scene: {ADVICE}"
        )
    model = structure.reconstruct(workplace, len(names), cfg.camera_model)

    missing = report.reasons(workplace, names, model)
    header = images.read_header(workplace.frames / names[0])
    sheet = report.contact_sheet(names, copies, moving, header.size, model, missing)
    images.write_image(work / "contact_sheet.png", sheet)
    if model is None or model.num_reg_images() < FEWEST_REGISTERED * len(names):
        raise UserError(_failure(source, work, names, missing))
    found = {
        "source": str(source),
        "decoded": len(candidates),
        "sampled": len(names),
        **report.measure(model),
        "moving_area": round(float(np.mean(moving)), 4),
        "brightening": tone._asdict(),
        "not_registered": missing,
        "origins": {candidates[i].name: candidates[i].origin for i in chosen},
    }
    with new_folder(output) as folder:
        (folder / "images").mkdir()
        for name in names:
            if name not in missing:
                shutil.copyfile(workplace.frames / name, folder / "images" / name)
        (folder / "sparse" / "0").mkdir(parents=True)
        model.write_binary(folder / "sparse" / "0")
        shutil.copyfile(work / "contact_sheet.png", folder / "contact_sheet.png")
        write_json(folder / "report.json", found)
    shutil.rmtree(work)
    return found


def _open_work(source: Path, output: Path, cfg: CaptureConfig) -> Path:
    """The folder of intermediate results; results of other settings or another source are deleted."""
    work = output.absolute().with_name(f"{output.absolute().name}.partial")
    # not the folder itself, which changes if `output` is inside
    files = sorted(filter(Path.is_file, source.iterdir())) if source.is_dir() else [source]
    settings = json.dumps(
        {
            "source": str(source.absolute()),
            "changed": {path.name: path.stat().st_mtime_ns for path in files},
            "frames": cfg.frames,
            "camera_model": cfg.camera_model,
        },
        indent=2,
    )
    record = work / "settings.json"
    if work.exists():
        if not record.is_file() and any(work.iterdir()):
            raise UserError(f"{work}: exists, but prepare has not written it; expected a free name for its work")
        if record.is_file() and record.read_text() == settings:
            print(f"going on in {work}")
            return work
        shutil.rmtree(work)
    work.mkdir(parents=True)
    record.write_text(settings)
    return work


def _scan(source: Path, work: Path) -> list[Candidate]:
    record = work / "candidates.json"
    if record.exists():
        return [Candidate(*fields) for fields in json.loads(record.read_text())]
    candidates = frames.scan(source)
    if len(candidates) < FEWEST_FRAMES:
        raise UserError(
            f"{source}: holds {len(candidates)} frame(s); "
            f"expected a video or a folder of at least {FEWEST_FRAMES} frames of a moving camera"
        )
    with replacing(record) as temporary:
        temporary.write_text(json.dumps(candidates))
    return candidates


def _brighten(
    workplace: Workplace, names: Sequence[str], curve: Curve
) -> tuple[brighten.Tone, list[UInt8[np.ndarray, "h w"]]]:
    """Write the copies in which features are found; returns them at the size at which flow is computed."""
    tone = brighten.tone_for(images.read_image(workplace.frames / name) for name in names)
    copies = []
    for name in tqdm(names, desc="brightening", unit="frame", dynamic_ncols=True):
        copy = curve(images.read_image(workplace.frames / name), tone)
        if not (workplace.copies / name).exists():
            images.write_image(workplace.copies / name, copy)
        copies.append(motion.small(copy))
    return tone, copies


def _mask(
    workplace: Workplace, names: Sequence[str], copies: Sequence[UInt8[np.ndarray, "h w"]]
) -> list[Bool[np.ndarray, "h w"]]:
    """Write COLMAP's masks, 0 where something moves; returns the moving regions at the size of `copies`."""
    record = workplace.masks.with_name("moving.npz")
    if record.exists():
        return list(np.load(record)["moving"])
    moving = []
    size = images.read_header(workplace.frames / names[0]).size
    regions = motion.moving_regions(copies)
    for name, region in tqdm(
        zip(names, regions, strict=True), total=len(names), desc="motion", unit="frame", dynamic_ncols=True
    ):
        mask = cv2.resize(images.to_bytes(~region), size, interpolation=cv2.INTER_NEAREST)
        images.write_image(workplace.masks / f"{name}.png", mask)
        moving.append(region)
    with replacing(record) as temporary:
        np.savez_compressed(temporary, moving=np.stack(moving))
    return moving


def _failure(source: Path, work: Path, names: Sequence[str], missing: dict[str, str]) -> str:
    few = [f"{name} ({why})" for name, why in list(missing.items())[:3]]
    more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
    return (
        f"{source}: {len(names) - len(missing)} of {len(names)} frames found a pose; expected at least half: "
        f"{', '.join(few)}{more}, see {work / 'contact_sheet.png'}; {ADVICE}"
    )
