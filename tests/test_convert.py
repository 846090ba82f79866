"""Scenes written in a layout and read again."""

import dataclasses

import numpy as np
import pytest
from scenes import write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import nerfies
from l2dgs_jax.errors import UserError

WRITERS = {"nerfies": nerfies.write}


def assert_same(a, b):
    """Equal but for the rounding of the pictures to 8 bits."""
    assert (a.width, a.height) == (b.width, b.height)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.colors, b.colors)
    for left, right in ((a.train, b.train), (a.test, b.test)):
        assert left.names == right.names
        np.testing.assert_allclose(left.cameras.viewmat, right.cameras.viewmat, rtol=0, atol=1e-6)
        np.testing.assert_allclose(left.cameras.K, right.cameras.K, rtol=1e-6)
        np.testing.assert_array_equal(left.cameras.time, right.cameras.time)
        np.testing.assert_array_equal(to_bytes(left.images), to_bytes(right.images))
        for kind in ("welllit", "masks", "valid", "covisible"):
            one, other = getattr(left, kind), getattr(right, kind)
            assert (one is None) == (other is None), kind
            if one is not None:
                np.testing.assert_array_equal(to_bytes(one), to_bytes(other))


def to_bytes(values):
    return np.rint(np.asarray(values, float) * 255)


def part(split, chosen):
    """A few frames of a split, with masks."""
    count, shape = len(chosen), split.images.shape[1:3]
    pick = lambda x: None if x is None else x[chosen]
    return dataclasses.replace(
        split,
        names=tuple(split.names[i] for i in chosen),
        cameras=type(split.cameras)(*(x[chosen] for x in split.cameras)),
        images=split.images[chosen],
        welllit=pick(split.welllit),
        masks=pick(split.masks),
        valid=np.random.default_rng(0).random((count, *shape)) < 0.8,
        covisible=np.random.default_rng(1).random((count, *shape)) < 0.8,
    )


@pytest.mark.parametrize("layout", WRITERS)
def test_a_written_scene_reads_the_same(tmp_path, layout):
    dataset = data.load(write_nerfies(tmp_path / "scene", truth=True))
    WRITERS[layout](dataset, tmp_path / "copy")
    assert_same(data.load(tmp_path / "copy"), dataset)


@pytest.mark.parametrize("layout", WRITERS)
def test_instants_of_part_of_a_scene_and_its_masks_survive(tmp_path, layout):
    dataset = data.load(write_nerfies(tmp_path / "scene", truth=True))
    some = dataclasses.replace(dataset, train=part(dataset.train, [1, 2, 4]), test=part(dataset.test, [1]))
    assert some.train.cameras.time.min() > 0
    WRITERS[layout](some, tmp_path / "copy")
    assert_same(data.load(tmp_path / "copy"), some)


@pytest.mark.parametrize("layout", WRITERS)
def test_nothing_is_written_over_files_or_half(tmp_path, monkeypatch, layout):
    def fill_the_disk(*_):
        raise OSError(28, "No space left on device")

    dataset = data.load(write_nerfies(tmp_path / "scene"))
    with pytest.raises(UserError, match="scene: exists already; expected a new or an empty folder"):
        WRITERS[layout](dataset, tmp_path / "scene")
    monkeypatch.setattr(np, "save", fill_the_disk)
    with pytest.raises(UserError, match=r"copy: cannot be written \(No space left on device\)"):
        WRITERS[layout](dataset, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
