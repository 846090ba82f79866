"""Contact sheet, path through space and time, and the files they are written to."""

import cv2
import finished_run
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax import visualize
from l2dgs_jax.data import images
from l2dgs_jax.errors import UserError
from l2dgs_jax.types import Camera, RenderOutput


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return finished_run.opened(tmp_path_factory.getbasetemp())


def walk(frames=40, jitter=0.0, seed=0):
    """A camera that walks along x while it turns, with noise."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)
    centres = np.stack([2 * time, 0.1 * np.sin(3 * time), 0.2 * time], -1) + jitter * rng.normal(size=(frames, 3))
    rotations = Rotation.from_rotvec(np.outer(0.5 * time, [0, 1, 0])).as_matrix()
    viewmat = np.tile(np.eye(4), (frames, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, centres)
    K = np.tile(np.array([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]), (frames, 1, 1))
    return Camera(*(x.astype(np.float32) for x in (viewmat, K, time)))


def centres_of(cameras):
    return -np.einsum("fji,fj->fi", cameras.viewmat[:, :3, :3], cameras.viewmat[:, :3, 3])


@pytest.mark.parametrize("frames", [1, 2, 5, 96])
def test_path_has_valid_cameras_and_time_runs_once(frames):
    cameras = walk(jitter=0.02)
    path = visualize.space_time_path(cameras, frames)
    rotations = path.viewmat[:, :3, :3]
    assert all(x.dtype == np.float32 for x in path)
    assert path.viewmat.shape == (frames, 4, 4)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (frames, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-5)
    np.testing.assert_array_equal(path.viewmat[:, 3], np.tile([0, 0, 0, 1], (frames, 1)))
    np.testing.assert_allclose(path.K, np.tile(cameras.K[0], (frames, 1, 1)), rtol=1e-6)
    assert (np.diff(path.time) >= 0).all()
    assert path.time[0] == 0
    if frames > 1:
        assert path.time[-1] == 1


def test_path_first_moves_through_space_alone_then_follows_the_trained_views():
    cameras = walk()
    path = visualize.space_time_path(cameras, 96)
    still = path.time == 0
    assert 20 < still.sum() < 30
    centres = centres_of(path)
    assert np.ptp(centres[still], axis=0).max() > 0.01
    trained = centres_of(cameras)
    size = np.ptp(trained, axis=0).max()
    nearest = np.linalg.norm(centres[:, None] - trained[None], axis=-1).min(1)
    assert nearest.max() < 0.1 * size
    assert np.ptp(centres[:, 0]) > 0.8 * size


def test_path_does_not_depend_on_the_order_of_the_views():
    cameras = walk(jitter=0.05)
    order = np.random.default_rng(1).permutation(len(cameras.time))
    shuffled = visualize.space_time_path(Camera(*(x[order] for x in cameras)), 24)
    for a, b in zip(visualize.space_time_path(cameras, 24), shuffled, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_path_smooths_the_shake_of_the_hand():
    cameras = walk(frames=100, jitter=0.02)
    shake = lambda centres: np.abs(np.diff(centres, n=2, axis=0)).mean()
    assert shake(centres_of(visualize.space_time_path(cameras, 100))) < 0.2 * shake(centres_of(cameras))


def test_path_stays_near_one_view_where_the_views_jump_about():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rotations = Rotation.random(60, rng=rng).as_matrix()
    viewmat = np.tile(np.eye(4), (60, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, 4 * directions)
    cameras = Camera(viewmat, np.tile(np.eye(3), (60, 1, 1)), np.linspace(0, 1, 60))
    path = visualize.space_time_path(cameras, 48)
    centres = centres_of(path)
    nearest = np.linalg.norm(centres.mean(0) - 4 * directions, axis=-1).argmin()
    assert np.linalg.norm(centres - 4 * directions[nearest], axis=-1).max() < 1
    np.testing.assert_allclose(path.viewmat[:, :3, :3], np.tile(rotations[nearest], (48, 1, 1)), atol=1e-6)


def test_path_of_a_camera_that_stands_still():
    cameras = Camera(np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(3), (5, 1, 1)), np.linspace(0, 1, 5))
    path = visualize.space_time_path(cameras, 12)
    np.testing.assert_allclose(path.viewmat, np.tile(np.eye(4), (12, 1, 1)), atol=1e-12)


def test_contact_sheet_shows_every_part_of_the_render(run):
    sheet = visualize.contact_sheet(run)
    test, (height, width) = run.dataset.test, (run.dataset.height, run.dataset.width)
    factor = -(-visualize.CELL_WIDTHS[0] // width)
    cell_height, cell_width = factor * height, factor * width
    line = visualize.STRIP + cell_height + visualize.GAP
    rows = min(4, len(test.names))
    assert sheet.dtype == np.uint8
    assert sheet.shape == (
        visualize.STRIP + rows * line,
        len(visualize.COLUMNS) * (cell_width + visualize.GAP),
        3,
    )

    def cell(row, column):
        y = visualize.STRIP + row * line + visualize.STRIP
        x = visualize.COLUMNS.index(column) * (cell_width + visualize.GAP)
        block = sheet[y : y + cell_height, x : x + cell_width]
        small = block[::factor, ::factor]
        np.testing.assert_array_equal(small.repeat(factor, 0).repeat(factor, 1), block)
        return small

    expected = lambda image: np.rint(255 * np.clip(np.asarray(image, np.float32), 0, 1))
    for row, i in ((0, 0), (rows - 1, len(test.names) - 1)):
        images = run.renderer()(visualize.view(test.cameras, i)).images
        np.testing.assert_array_equal(cell(row, "input"), expected(test.images[i]))
        np.testing.assert_array_equal(cell(row, "truth"), expected(test.welllit[i]))
        np.testing.assert_array_equal(cell(row, "well-lit"), expected(images.welllit))
        np.testing.assert_array_equal(cell(row, "re-lit low light"), expected(images.lowlight))
        np.testing.assert_array_equal(cell(row, "R"), expected(images.reflectance))
        np.testing.assert_array_equal(cell(row, "L")[..., 1], expected(images.illumination))
        assert np.ptp(cell(row, "depth"), axis=(0, 1)).max() > 50
    for heading in range(len(visualize.COLUMNS)):
        x = heading * (cell_width + visualize.GAP)
        assert sheet[: visualize.STRIP, x : x + cell_width].max() > 200


def test_contact_sheet_without_held_out_views_or_truth_shows_training_views(run):
    bare = finished_run.without_truth_and_test(run)
    sheet = visualize.contact_sheet(bare, rows=2)
    factor = -(-visualize.CELL_WIDTHS[0] // bare.dataset.width)
    width = factor * bare.dataset.width + visualize.GAP
    assert sheet.shape[1] == (len(visualize.COLUMNS) - 1) * width
    top = 2 * visualize.STRIP
    first = sheet[top : top + factor * bare.dataset.height : factor, : width - visualize.GAP : factor]
    np.testing.assert_array_equal(first, np.rint(255 * bare.dataset.train.images[0].astype(np.float32)))


def test_wide_pictures_are_reduced_in_the_contact_sheet():
    cell = visualize.cell(np.full((300, 1000, 3), 77, np.uint8))
    assert cell.shape == (120, 400, 3)
    assert (cell == 77).all()


def test_video_plays_and_moves(run, tmp_path):
    path = tmp_path / "video.mp4"
    visualize.video(run, path)
    frames, rate = decode(path)
    assert len(frames) == visualize.VIDEO_SECONDS * visualize.VIDEO_RATE
    assert rate == visualize.VIDEO_RATE
    assert frames[0].shape == (run.dataset.height, 2 * run.dataset.width, 3)
    assert frames.std(axis=(1, 2, 3)).min() > 1
    assert frames.std(axis=0).max() > 1
    camera = visualize.view(visualize.space_time_path(run.dataset.train.cameras, len(frames)), 50)
    images = run.renderer()(camera).images
    expected = 255 * np.hstack([images.lowlight, images.welllit])
    assert np.abs(frames[50] - expected).mean() < 12  # the codec is lossy


def decode(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return np.stack(frames).astype(float), capture.get(cv2.CAP_PROP_FPS)


def test_video_of_odd_size_keeps_every_pixel_and_its_colour(tmp_path):
    ramp = np.linspace(0, 255, 33).astype(np.uint8)
    picture = np.zeros((21, 33, 3), np.uint8)
    picture[..., 0], picture[..., 2] = ramp, 100
    visualize.write_video(tmp_path / "odd.mp4", iter([picture] * 7), 10)
    frames, _ = decode(tmp_path / "odd.mp4")
    assert frames.shape == (7, 22, 34, 3)
    assert np.abs(frames[:, :21, :33] - picture).mean() < 6
    assert [p.name for p in tmp_path.iterdir()] == ["odd.mp4"]


def test_video_without_codec_is_a_clear_error(tmp_path, monkeypatch):
    class Broken:
        def __init__(self, *arguments):
            pass

        def isOpened(self):
            return False

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoWriter", Broken)
    monkeypatch.setattr(cv2, "VideoWriter_fourcc", lambda *code: 0, raising=False)
    with pytest.raises(UserError, match=r"video\.mp4.*expected an OpenCV with the mp4v codec"):
        visualize.write_video(tmp_path / "video.mp4", iter([np.zeros((4, 4, 3), np.uint8)]), 10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_written_images_read_back_exactly(tmp_path, shape, kind):
    image = np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
    images.write_image(tmp_path / "image.png", image)
    read = cv2.imread(str(tmp_path / "image.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read if len(shape) == 2 else read[..., ::-1], image)
    assert read.dtype == kind
    assert [p.name for p in tmp_path.iterdir()] == ["image.png"]


def test_files_that_cannot_be_written_are_clear_errors(tmp_path):
    image = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(UserError, match=r"missing/image\.png.*expected an existing folder .*missing"):
        images.write_image(tmp_path / "missing" / "image.png", image)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(UserError, match=r"folder\.png: is a folder; expected a file"):
        images.write_image(tmp_path / "folder.png", image)
    with pytest.raises(UserError, match=r"image\.nosuchformat.*cannot be written"):
        images.write_image(tmp_path / "image.nosuchformat", image)


def test_bytes_round_and_clip():
    values = np.array([-1.0, 0.0, 0.4 / 255, 0.6 / 255, 0.5, 1.0, 7.0])
    np.testing.assert_array_equal(images.to_bytes(values), [0, 0, 0, 1, 128, 255, 255])


def test_viridis_brightens_with_the_value_and_stands_a_constant():
    colours = visualize.viridis(np.linspace(2, 3, 64).reshape(1, -1), 2.0, 3.0)
    luminance = colours[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0).all()
    assert colours[0, 0, 2] > colours[0, 0, 1]  # violet, not the same colour with red and blue exchanged
    assert colours[0, -1, 0] > colours[0, -1, 2]  # yellow
    assert np.ptp(visualize.viridis(np.full((3, 4), 5.0), 5.0, 5.0)) < 100


def test_expected_depth_divides_by_alpha_and_is_zero_where_nothing_is():
    zero = np.zeros(())
    output = RenderOutput(None, np.array([[0.5, 0.0]]), np.array([[1.5, 0.0]]), zero, zero, zero)
    np.testing.assert_array_equal(visualize.expected_depth(output), [[3.0, 0.0]])
