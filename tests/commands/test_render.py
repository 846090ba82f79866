"""The command that writes the views of a run as images."""

import json

import cv2
import finished_run
import numpy as np
import pytest

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.render import main
from l2dgs_jax.runtime import command_line


@pytest.fixture(autouse=True)
def _no_compilation_cache(monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def test_images_are_the_renderers_output(base, tmp_path, capsys):
    run = finished_run.opened(base)
    command_line.run(main, [str(run.folder), "--output", str(tmp_path / "out")])
    folder = tmp_path / "out" / "test"
    assert f"wrote 2 views to {folder}" in capsys.readouterr().out
    unit = json.loads((folder / "depth.json").read_text())["unit"]
    written = {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    kinds = ("welllit", "lowlight", "illumination", "reflectance", "depth")
    names = run.dataset.test.names
    assert written == {f"{kind}/{name}.png" for kind in kinds for name in names} | {"depth.json"}

    highest = 0
    for i, name in enumerate(names):
        output = run.renderer()(select_camera(run.dataset.test.cameras, i))
        for kind in kinds[:-1]:
            image = cv2.imread(str(folder / kind / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            assert image.ndim == (2 if kind == "illumination" else 3)
            expected = np.asarray(getattr(output.images, kind), np.float32)
            colours = image if image.ndim == 2 else image[..., ::-1]
            np.testing.assert_array_equal(colours, np.rint(255 * np.clip(expected, 0, 1)))
        depth = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        highest = max(highest, depth.max())
        np.testing.assert_allclose(depth * unit, expected_depth(output), atol=unit)
        assert 1.5 < np.median(depth * unit) < 6.5  # the cameras stand 4 from the middle of points within 1.8 of it
    assert highest == 65535


def test_folders_of_splits_and_stages_do_not_collide(base, capsys):
    run_folder = finished_run.folder(base)
    command_line.run(main, [str(run_folder), "--split", "train", "--stage", "coarse"])
    assert (run_folder / "renders_coarse" / "train" / "welllit" / "000000.png").is_file()
    assert not (run_folder / "renders").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{missing}"], "missing: not a training run; expected a folder with config.json"),
        (["{file}"], "file: not a training run; expected a folder with config.json"),
        (["{run}", "--output", "{file}"], "expected a writable place"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(base, tmp_path, capsys, arguments, message):
    (tmp_path / "file").write_text("")
    places = {"missing": tmp_path / "missing", "file": tmp_path / "file", "run": finished_run.folder(base)}
    with pytest.raises(SystemExit) as leave:
        command_line.run(main, [argument.format(**places) for argument in arguments])
    assert leave.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
