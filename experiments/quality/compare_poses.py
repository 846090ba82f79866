"""How close the poses that `prepare` finds are to those of a Nerfies scene.

    python -m experiments.quality.compare_poses video SCENE clip.avi  # makes a video: .avi is lossless, .mp4 is not
    python -m l2dgs_jax.prepare clip.avi OUT                          # or the folder of frames instead of the video
    python -m experiments.quality.compare_poses compare SCENE OUT [--json FILE]  # adds the numbers to those in FILE

The found camera centres are aligned with the given ones by a similarity (Umeyama, PAMI 1991). Printed are the median
and the largest distance between centres, relative to the trajectory's length, and angle between orientations.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from skimage.transform import SimilarityTransform

from experiments.markdown import table_rows
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import write_json

FPS = 10


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("video", "compare"))
    parser.add_argument("scene", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--pictures", default="rgb/1x", help="folder of the frames within the scene")
    parser.add_argument("--skip", default="_r", help="leave out names that end like this")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    paths = sorted(p for p in (options.scene / options.pictures).iterdir() if not p.stem.endswith(options.skip))
    if options.command == "video":
        make_video(paths, options.target)
        return
    found = compare(options.scene, paths, options.target)
    print(json.dumps(found, indent=2))
    if options.json:
        others = json.loads(options.json.read_text()) if options.json.exists() else {}
        write_json(options.json, others | {options.scene.name: found})


def markdown(clips: dict[str, dict]) -> str:
    """A table of the clips' medians, as --json writes them."""
    lines = [["", "frames with a pose", "distance between centres", "angle"], ["---"] * 4]
    for clip, found in clips.items():
        frames = f"{found['registered']} of {found['of']}"
        lines.append([clip, frames, f"{found['distance_median']:.2%}", f"{found['angle_median_deg']:.1f} degrees"])
    return table_rows(lines)


def make_video(paths: list[Path], target: Path) -> None:
    first = cv2.imread(str(paths[0]))
    codec = "FFV1" if target.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(target), cv2.VideoWriter_fourcc(*codec), FPS, first.shape[1::-1])
    for path in paths:
        writer.write(cv2.imread(str(path)))
    writer.release()


def compare(scene: Path, paths: list[Path], prepared: Path) -> dict:
    model = pycolmap.Reconstruction(prepared / "sparse" / "0")
    origins = json.loads((prepared / "report.json").read_text())["origins"]
    views = [model.image(i) for i in model.reg_image_ids()]
    names = [_frame(origins[view.name], paths) for view in views]
    order = np.argsort(names)
    given = [json.loads((scene / "camera" / f"{names[i]}.json").read_text()) for i in order]
    found_centres = np.array([views[i].projection_center() for i in order])
    found_rotations = np.array([views[i].cam_from_world().rotation.matrix() for i in order])
    centres = np.array([camera["position"] for camera in given])
    rotations = np.array([camera["orientation"] for camera in given])

    similarity = SimilarityTransform.from_estimate(found_centres, centres)
    turn = similarity.params[:3, :3] / similarity.scale
    distances = np.linalg.norm(similarity(found_centres) - centres, axis=-1)
    length = np.linalg.norm(np.diff(centres, axis=0), axis=-1).sum()
    traces = np.einsum("fij,kj,fik->f", found_rotations, turn, rotations)
    angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    return {
        "registered": len(views),
        "of": len(origins),
        "focal_length": {"found": next(iter(model.cameras.values())).params[0], "given": given[0]["focal_length"]},
        "distance_median": float(np.median(distances) / length),
        "distance_max": float(distances.max() / length),
        "angle_median_deg": float(np.median(angles)),
        "angle_max_deg": float(angles.max()),
    }


def _frame(origin: str, paths: list[Path]) -> str:
    """The scene's name of a frame, from its position in the video or the name of its picture."""
    return paths[int(origin.removeprefix("frame "))].stem if origin.startswith("frame ") else Path(origin).stem


if __name__ == "__main__":
    command_line.run(main)
