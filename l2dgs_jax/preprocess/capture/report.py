"""The result of structure from motion as numbers, as text, and as a contact sheet."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.distance import pdist

from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.preprocess.capture import structure
from l2dgs_jax.preprocess.capture.structure import Workplace
from l2dgs_jax.visualize.sheet import GAP, cell, text_strip

FEW_FEATURES = 100  # below which a frame is taken to lack features
FEW_MATCHES = 30  # below which COLMAP does not attempt to find a pose
COLUMNS = 6  # of the contact sheet
MOST_CELLS = 36

_GREEN, _RED = (80, 255, 80), (255, 70, 70)


def measure(model: Any) -> dict:
    """Statistics of a reconstruction that can be written as JSON."""
    camera = next(iter(model.cameras.values()))
    views = [model.image(i) for i in model.reg_image_ids()]
    centres = np.stack([view.projection_center() for view in views])
    depths = np.concatenate([_depths(model, view) for view in views])
    baseline = float(pdist(centres).max())
    return {
        "registered": len(views),
        "points": model.num_points3D(),
        "reprojection_error_px": round(model.compute_mean_reprojection_error(), 3),
        "mean_track_length": round(model.compute_mean_track_length(), 2),
        "camera": {
            "model": camera.model_name,
            "width": camera.width,
            "height": camera.height,
            "focal_length_px": round(camera.mean_focal_length(), 2),
            "params": [round(float(x), 6) for x in camera.params],
        },
        "baseline_to_depth": round(baseline / float(np.median(depths)), 4),
    }


def reasons(workplace: Workplace, names: Sequence[str], model: Any | None) -> dict[str, str]:
    """The likely reason for each frame without a pose, by name."""
    colmap = structure.pycolmap()
    registered = set() if model is None else set(model.reg_image_ids())
    with colmap.Database.open(workplace.database) as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        features = {i: database.num_keypoints_for_image(i) for i in images.values()}
        pairs = list(zip(*database.read_two_view_geometry_num_inliers(), strict=True))
    matches = dict.fromkeys(images.values(), 0)
    for pair, count in pairs:
        first, second = colmap.pair_id_to_image_pair(pair)
        for one, other in ((first, second), (second, first)):
            if other in registered or not registered:
                matches[one] = max(matches[one], count)
    found = {}
    for name in names:
        number = images[name]
        if number in registered:
            continue
        if features[number] < FEW_FEATURES:
            found[name] = f"{features[number]} features: too dark, too blurred or too plain"
        elif matches[number] < FEW_MATCHES:
            found[name] = f"{matches[number]} matches: too little overlap or too fast a motion"
        else:
            found[name] = "its matches fit no pose: hardly any parallax, or much of it moves"
    return found


def summary(report: Mapping[str, Any]) -> str:
    """The report in a few lines."""
    camera = report["camera"]
    lines = [
        f"registered    {report['registered']} of {report['sampled']} frames",
        f"points        {report['points']}, each seen in {report['mean_track_length']} frames on average",
        f"reprojection  {report['reprojection_error_px']} px on average",
        f"camera        {camera['model']}, {camera['width']}x{camera['height']}, f = {camera['focal_length_px']} px",
        f"baseline      {report['baseline_to_depth']} of the median depth",
    ]
    return "\n".join(lines + [f"not registered: {name} ({why})" for name, why in report["not_registered"].items()])


def contact_sheet(
    names: Sequence[str],
    copies: Sequence[UInt8[np.ndarray, "h w"]],
    moving: Sequence[Bool[np.ndarray, "h w"]],
    size: tuple[int, int],
    model: Any | None,
    unregistered: Mapping[str, str],
) -> UInt8[np.ndarray, "H W 3"]:
    """The brightened frames, with moving regions in red and points of the reconstruction in green.

    Args:
        names: of the frames.
        copies: their brightened copies, of any common size.
        moving: where something moves.
        size: full width and height of the frames, to which pixels in the reconstruction refer.
        model: the reconstruction, if there is one.
        unregistered: reasons why frames have no pose, by name; these frames are all shown, of the others only some.
    """
    points = {} if model is None else {v.name: _observed(v) for v in map(model.image, model.reg_image_ids())}
    spread = evenly_spread(len(names), MOST_CELLS).tolist()
    shown = sorted({*spread, *(i for i, name in enumerate(names) if name in unregistered)})
    cells = []
    for i in shown:
        picture = np.repeat(copies[i][..., None], 3, axis=-1)
        picture[moving[i]] = picture[moving[i]] // 2 + np.array([127, 0, 0], np.uint8)
        scale = np.array(copies[i].shape[::-1]) / size
        for x, y in points.get(names[i], np.empty((0, 2))) * scale:
            cv2.circle(picture, (int(x), int(y)), 1, _GREEN, -1)
        if names[i] in unregistered:
            picture = cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), _RED, 5)
        picture = cell(picture)
        why = unregistered.get(names[i], f"{len(points.get(names[i], ()))} points")
        mark = "NO POSE" if names[i] in unregistered else "ok"
        lines = [text_strip(f"{names[i]} {mark}", picture.shape[1]), text_strip(why, picture.shape[1]), picture]
        cells.append(np.pad(np.vstack(lines), ((0, GAP), (0, GAP), (0, 0))))
    cells += [np.zeros_like(cells[0])] * (-len(cells) % COLUMNS)
    return np.vstack([np.hstack(cells[i : i + COLUMNS]) for i in range(0, len(cells), COLUMNS)])


def _observed(view: Any) -> Float[np.ndarray, "P 2"]:
    """Pixels at which a view observes points."""
    return np.array([point.xy for point in view.get_observation_points2D()]).reshape(-1, 2)


def _depths(model: Any, view: Any) -> Float[np.ndarray, " P"]:
    """Depths in a view of the points that it observes."""
    ids = [point.point3D_id for point in view.get_observation_points2D()]
    points = np.array([model.point3D(i).xyz for i in ids]).reshape(-1, 3)
    pose = view.cam_from_world().matrix()
    return points @ pose[2, :3] + pose[2, 3]
