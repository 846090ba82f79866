"""The contact sheet, and writing pictures to files."""

import dataclasses

import cv2
import finished_run
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.cameras.geometry import select_camera
from l2dgs_jax.data import images
from l2dgs_jax.errors import UserError
from l2dgs_jax.visualize import display
from l2dgs_jax.visualize.contact_sheet import COLUMNS, contact_sheet
from l2dgs_jax.visualize.sheet import CELL_WIDTHS, GAP, STRIP_HEIGHT, cell, viridis


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run whose exponents differ from pixel to pixel."""
    run = finished_run.opened(tmp_path_factory.getbasetemp())
    rng = np.random.default_rng(0)
    params = run.state.scene.params
    shape = params.gaussians.attenuation.shape
    params = params._replace(
        gaussians=params.gaussians._replace(attenuation=jnp.asarray(rng.normal(0, 1, shape))),
        bafe=jax.tree.map(jnp.zeros_like, params.bafe),
    )
    return dataclasses.replace(run, state=run.state._replace(scene=run.state.scene._replace(params=params)))


def test_contact_sheet_shows_every_part_of_the_render(run):
    sheet = contact_sheet(run)
    test, (height, width) = run.dataset.test, (run.dataset.height, run.dataset.width)
    factor = -(-CELL_WIDTHS[0] // width)
    cell_height, cell_width = factor * height, factor * width
    line = STRIP_HEIGHT + cell_height + GAP
    rows = min(4, len(test.names))
    assert sheet.dtype == np.uint8
    assert sheet.shape == (
        STRIP_HEIGHT + rows * line,
        len(COLUMNS) * (cell_width + GAP),
        3,
    )

    def cell(row, column):
        y = STRIP_HEIGHT + row * line + STRIP_HEIGHT
        x = COLUMNS.index(column) * (cell_width + GAP)
        block = sheet[y : y + cell_height, x : x + cell_width]
        small = block[::factor, ::factor]
        np.testing.assert_array_equal(small.repeat(factor, 0).repeat(factor, 1), block)
        return small

    expected = lambda image: np.rint(255 * np.clip(np.asarray(image, np.float32), 0, 1))
    for row, i in ((0, 0), (rows - 1, len(test.names) - 1)):
        images = run.renderer()(select_camera(test.cameras, i)).images
        np.testing.assert_array_equal(cell(row, "input"), expected(test.images[i]))
        np.testing.assert_array_equal(cell(row, "truth"), expected(test.welllit[i]))
        np.testing.assert_array_equal(cell(row, "well-lit"), expected(images.welllit))
        np.testing.assert_array_equal(cell(row, "low-light"), expected(images.lowlight))
        np.testing.assert_array_equal(cell(row, "R"), expected(images.reflectance))
        for column, values in (("B1", images.attenuation[..., 0]), ("B2", images.attenuation[..., 1])):
            # Brighter in the picture where it is larger: viridis gains green with every step.
            assert np.corrcoef(cell(row, column)[..., 1].ravel(), np.asarray(values).ravel())[0, 1] > 0.9
        np.testing.assert_array_equal(cell(row, "L")[..., 1], expected(images.illumination))
        assert np.ptp(cell(row, "depth"), axis=(0, 1)).max() > 50
    for heading in range(len(COLUMNS)):
        x = heading * (cell_width + GAP)
        assert sheet[:STRIP_HEIGHT, x : x + cell_width].max() > 200


def test_an_exponent_that_is_constant_has_one_colour(run):
    output = run.renderer()(select_camera(run.dataset.test.cameras, 0))
    rounded = 1.01 + 1e-6 * np.random.default_rng(0).normal(size=output.images.attenuation.shape)
    output = output._replace(images=output.images._replace(attenuation=rounded))
    shown = display.shown(output, "b1", display.ranges([output]))
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) == 1


def test_contact_sheet_without_held_out_views_or_truth_shows_training_views(run):
    bare = finished_run.without_truth_and_test(run)
    sheet = contact_sheet(bare, rows=2)
    factor = -(-CELL_WIDTHS[0] // bare.dataset.width)
    width = factor * bare.dataset.width + GAP
    assert sheet.shape[1] == (len(COLUMNS) - 1) * width
    top = 2 * STRIP_HEIGHT
    first = sheet[top : top + factor * bare.dataset.height : factor, : width - GAP : factor]
    np.testing.assert_array_equal(first, np.rint(255 * bare.dataset.train.images[0].astype(np.float32)))


def test_wide_pictures_are_reduced_in_the_contact_sheet():
    shown = cell(np.full((300, 1000, 3), 77, np.uint8))
    assert shown.shape == (120, 400, 3)
    assert (shown == 77).all()


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_written_images_read_back_exactly(tmp_path, shape, kind):
    image = np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
    images.write_image(tmp_path / "image.png", image)
    read = cv2.imread(str(tmp_path / "image.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read if len(shape) == 2 else read[..., ::-1], image)
    assert read.dtype == kind
    assert [p.name for p in tmp_path.iterdir()] == ["image.png"]


def test_files_that_cannot_be_written_are_reported(tmp_path):
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


def test_viridis_brightens_with_the_value_and_accepts_a_constant():
    colours = viridis(np.linspace(2, 3, 64).reshape(1, -1), 2.0, 3.0)
    luminance = colours[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0).all()
    assert colours[0, 0, 2] > colours[0, 0, 1]  # violet, not the same colour with red and blue exchanged
    assert colours[0, -1, 0] > colours[0, -1, 2]  # yellow
    assert np.ptp(viridis(np.full((3, 4), 5.0), 5.0, 5.0)) < 100
