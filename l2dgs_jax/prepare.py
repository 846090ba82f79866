"""`python -m l2dgs_jax.prepare VIDEO_OR_FOLDER OUT`: poses and points for a video of one's own, dark as it may be."""

import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from jaxtyping import Bool, UInt8
from tqdm import tqdm

from l2dgs_jax import cli
from l2dgs_jax.capture import brighten, frames, motion, report, structure
from l2dgs_jax.capture.frames import Candidate
from l2dgs_jax.capture.structure import CameraModel, Workplace
from l2dgs_jax.data import images
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import expect_new, new_folder, replacing

FEWEST_FRAMES = 5
FEWEST_REGISTERED = 0.5  # part of the frames
LEAST_PARALLAX = 0.05  # part of the pairs of frames that must show some
ADVICE = (
    "film more slowly, with more light and more overlap, and walk instead of turning on the spot; "
    "or try more --frames, or another --camera-model"
)


@dataclass(frozen=True)
class Prepare:
    """Make a scene that `train` reads out of a video, or of a folder of frames, of a moving camera.

    Attributes:
        source: the video, or the folder of frames whose names count them.
        output: folder to make; the work on it is kept in OUT.partial, where the same command goes on after an
            interruption.
        frames: how many to take at most, evenly spaced and sharp.
        camera_model: COLMAP's name of the lens that all frames share.
        threads: processor threads for structure from motion; 0 for all. Only 1 gives the same numbers every time.
    """

    source: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    frames: int = 120
    camera_model: CameraModel = "SIMPLE_RADIAL"
    threads: int = 0


def main(arguments: Sequence[str]) -> None:
    """Prepare as the command line says."""
    options = cli.parse(Prepare, arguments, "prepare")
    if options.frames < FEWEST_FRAMES:
        raise UserError(f"--frames {options.frames}: expected at least {FEWEST_FRAMES}")
    if options.threads < 0:
        raise UserError(f"--threads {options.threads}: expected 0, for all, or a number of threads")
    structure.pycolmap()
    if not options.source.exists():
        raise UserError(f"{options.source}: no such file or folder; expected a video or a folder of frames")
    expect_new(options.output)
    try:
        found = prepare(options, _open_work(options))
    except OSError as error:
        raise UserError(f"{options.output}: cannot be made ({error.strerror}); expected a writable place") from None
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    print(report.summary(found))
    print(f"next: look at {options.output / 'contact_sheet.png'}, then python -m l2dgs_jax.train {options.output}")


def prepare(options: Prepare, work: Path) -> dict:
    """Make the scene: frames, COLMAP's model, `report.json` and `contact_sheet.png`.

    Args:
        options: of the command line.
        work: folder of what earlier calls with the same options have done; removed once the scene is whole.

    Returns:
        The report.

    Raises:
        UserError: the source cannot be read, the camera does not move, or too few frames find a pose; `work` then
            holds a contact sheet that shows why.
    """
    threads = options.threads or os.cpu_count() or 1
    place = Workplace(work / "frames", work / "copies", work / "masks", work / "database.db", work / "models", threads)
    for made in (place.frames, place.copies, place.masks):
        made.mkdir(exist_ok=True)
    candidates = _scan(options.source, work)
    if len(candidates) < FEWEST_FRAMES:
        raise UserError(
            f"{options.source}: holds {len(candidates)} frame(s); "
            f"expected a video or a folder of at least {FEWEST_FRAMES} frames of a moving camera"
        )
    chosen = frames.choose([candidate.sharpness for candidate in candidates], options.frames)
    frames.extract(options.source, candidates, chosen, place.frames)
    names = [candidates[i].name for i in chosen]
    tone, copies = _brighten(place, names)
    shift = motion.camera_shift(copies)
    if shift < motion.STILL:
        raise UserError(
            f"{options.source}: the camera stands still (the picture shifts by {shift:.1f} of {copies[0].shape[1]} "
            "pixels); expected a camera that moves through the scene, as depth shows in parallax only"
        )
    moving = _mask(place, names, copies)
    structure.find_features(place, names, options.camera_model)
    structure.match_features(place, names)
    pairs, with_parallax = structure.count_pairs(place)
    if with_parallax < LEAST_PARALLAX * pairs:
        raise UserError(
            f"{options.source}: {with_parallax} of {pairs} pairs of frames show parallax, so the camera only turns or "
            f"sees a flat surface; expected a camera that moves through the scene: {ADVICE}"
        )
    model = structure.reconstruct(place, len(names))

    missing = report.reasons(place, names, model)
    header = images.read_header(place.frames / names[0])
    sheet = report.contact_sheet(names, copies, moving, header.size, model, missing)
    images.write_image(work / "contact_sheet.png", sheet)
    if model is None or model.num_reg_images() < FEWEST_REGISTERED * len(names):
        raise UserError(_failure(options, work, names, missing))
    found = {
        "source": str(options.source),
        "decoded": len(candidates),
        "sampled": len(names),
        **report.measure(model),
        "moving_area": round(float(np.mean(moving)), 4),
        "brightening": tone._asdict(),
        "not_registered": missing,
        "origins": {candidates[i].name: candidates[i].origin for i in chosen},
    }
    with new_folder(options.output) as folder:
        (folder / "images").mkdir()
        for name in names:
            if name not in missing:
                shutil.copyfile(place.frames / name, folder / "images" / name)
        (folder / "sparse" / "0").mkdir(parents=True)
        model.write_binary(folder / "sparse" / "0")
        shutil.copyfile(work / "contact_sheet.png", folder / "contact_sheet.png")
        (folder / "report.json").write_text(json.dumps(found, indent=2) + "\n")
    shutil.rmtree(work)
    return found


def _open_work(options: Prepare) -> Path:
    """The folder of intermediate results; those of other settings or of another source are cleared away."""
    work = options.output.absolute().with_name(f"{options.output.absolute().name}.partial")
    inside = options.source.iterdir() if options.source.is_dir() else ()
    settings = json.dumps(
        {
            "source": str(options.source.absolute()),
            "changed": max(path.stat().st_mtime_ns for path in (options.source, *inside)),
            "frames": options.frames,
            "camera_model": options.camera_model,
        },
        indent=2,
    )
    record = work / "settings.json"
    if work.exists():
        if not record.is_file() and any(work.iterdir()):
            raise UserError(f"{work}: is not what prepare left there; expected a free name for its work")
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
    with replacing(record) as temporary:
        temporary.write_text(json.dumps(candidates))
    return candidates


def _brighten(place: Workplace, names: Sequence[str]) -> tuple[brighten.Tone, list[UInt8[np.ndarray, "h w"]]]:
    """Write the copies that features are found in; returns them at the size that flow is computed on."""
    tone = brighten.tone_for(images.read_image(place.frames / name) for name in names)
    copies = []
    for name in tqdm(names, desc="brightening", unit="frame", dynamic_ncols=True):
        copy = brighten.brighten(images.read_image(place.frames / name), tone)
        if not (place.copies / name).exists():
            images.write_image(place.copies / name, copy)
        copies.append(motion.small(copy))
    return tone, copies


def _mask(
    place: Workplace, names: Sequence[str], copies: Sequence[UInt8[np.ndarray, "h w"]]
) -> list[Bool[np.ndarray, "h w"]]:
    """Write COLMAP's masks, 0 where something moves; returns where, at the size of `copies`."""
    record = place.masks.with_name("moving.npz")
    if record.exists():
        return list(np.load(record)["moving"])
    moving = []
    size = images.read_header(place.frames / names[0]).size
    regions = motion.moving_regions(copies)
    for name, region in tqdm(
        zip(names, regions, strict=True), total=len(names), desc="motion", unit="frame", dynamic_ncols=True
    ):
        mask = cv2.resize(images.to_bytes(~region), size, interpolation=cv2.INTER_NEAREST)
        images.write_image(place.masks / f"{name}.png", mask)
        moving.append(region)
    with replacing(record) as temporary:
        np.savez_compressed(temporary, moving=np.stack(moving))
    return moving


def _failure(options: Prepare, work: Path, names: Sequence[str], missing: dict[str, str]) -> str:
    few = [f"{name} ({why})" for name, why in list(missing.items())[:3]]
    more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
    return (
        f"{options.source}: {len(names) - len(missing)} of {len(names)} frames found a pose; expected at least half: "
        f"{', '.join(few)}{more}, see {work / 'contact_sheet.png'}; {ADVICE}"
    )


if __name__ == "__main__":
    cli.main(main)
