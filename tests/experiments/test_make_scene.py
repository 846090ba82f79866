import mitsuba as mi
import numpy as np
import pytest

from experiments.makers import make_scene
from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.data import load_dataset, nerfies

FRAMES = 4
SEEN = {"walk": "head0", "approach": "head0", "crowd": "nearhead0", "table": "hand0"}  # a part that nothing hides


@pytest.fixture(scope="module", params=sorted(make_scene.SCENES))
def dataset(request, tmp_path_factory):
    mi.set_variant("scalar_rgb")
    folder = tmp_path_factory.mktemp("made") / request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make_scene, "SAMPLES", 1)
        nerfies.write(make_scene.make(request.param, FRAMES), folder)
    return load_dataset(str(folder))


def test_the_scene_is_read_with_the_second_camera_held_out(dataset):
    assert dataset.train.names == ("000000", "000001", "000002", "000003")
    assert dataset.test.names == ("000000_r", "000003_r")
    scene = make_scene.SCENES[dataset.name]
    (first, _), (second, _) = (scene.film(0.0, x) for x in (0.0, scene.baseline))
    np.testing.assert_allclose(np.linalg.norm(second - first), scene.baseline)


@pytest.mark.parametrize("split", ["train", "test"])
def test_masks_show_what_moves_where_the_cameras_see_it(dataset, split):
    split = getattr(dataset, split)
    for i, time in enumerate(split.cameras.time):
        parts = make_scene.SCENES[dataset.name].move(float(time))
        center = np.array(parts[SEEN[dataset.name]]["center"], np.float32)
        pixels, _ = project_points(center[None], split.cameras.viewmat[i], split.cameras.K[i])
        column, row = np.floor(pixels[0]).astype(int)
        assert split.masks[i, row, column]
        assert split.masks[i].mean() < 0.2


def test_points_lie_on_what_stands_still(dataset):
    masks, cameras = dataset.train.masks, dataset.train.cameras
    per_frame = len(dataset.points) // FRAMES
    for i in range(FRAMES):
        points = dataset.points[i * per_frame : (i + 1) * per_frame]
        pixels, depth = project_points(points, cameras.viewmat[i], cameras.K[i])
        column, row = np.floor(pixels).astype(int).T
        assert (depth > 2 * make_scene.SCENES[dataset.name].baseline).all()  # nothing is close to the camera
        assert not masks[i, row.clip(0, masks.shape[1] - 1), column.clip(0, masks.shape[2] - 1)].any()
    assert dataset.points[:, 2].min() > -0.1  # nothing is below the ground
