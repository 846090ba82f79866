"""Tracks: moving Gaussians stored as integers, and read back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax.exporters import tracks
from l2dgs_jax.exporters.splats import Splats, visible

KEYS, STILL, MOVING = 5, 30, 40
BRIGHTEST = 1.25


@pytest.fixture
def instants():
    """Gaussians at key instants: static, moving, and one always invisible; with colours for two images."""
    rng = np.random.default_rng(0)
    count = STILL + MOVING + 1
    moves = rng.permutation(count) >= STILL
    hidden = np.flatnonzero(moves)[0]
    start, velocity = rng.normal(0, 1, (count, 3)), rng.normal(0, 0.3, (count, 3)) * moves[:, None]
    axes, scales = rng.normal(0, 1, (count, 3)), np.exp(rng.normal(-3, 1, (count, 3)))
    opacities = np.where(np.arange(count) == hidden, 0.003, rng.uniform(0.1, 1, count))
    gaussians = []
    for time in np.linspace(0, 1, KEYS):
        quats = Rotation.from_rotvec(axes * (1 + time * moves[:, None])).as_quat(scalar_first=True)
        quats *= rng.choice([-1, 1], (count, 1))  # the same rotations
        grown = scales * np.exp(0.5 * time * moves[:, None])
        arrays = (start + time * velocity, quats, grown, opacities, rng.uniform(0, BRIGHTEST, (count, 3)))
        welllit = Splats(*(array.astype(np.float32) for array in arrays))
        gaussians.append((welllit, welllit._replace(colors=welllit.colors / 2)))
    return gaussians


def quantised(instants):
    count = len(instants[0][0].means)
    return tracks.quantise(instants, np.full(count, 1e-3), BRIGHTEST)


def in_order(splats, like):
    """Gaussians in the order of those in `like`, matched by nearest centres."""
    distances = np.linalg.norm(splats.means[:, None] - like.means[None], axis=-1)
    nearest = distances.argmin(0)
    assert len(set(nearest)) == len(like.means) == len(splats.means)
    return Splats(*(rows[nearest] for rows in splats))


def test_key_instants_are_restored_to_the_precision_of_the_integers(instants):
    packed = quantised(instants)
    assert packed.still.positions.shape == (1, STILL, 3)
    assert packed.moving.positions.shape == (KEYS, MOVING, 3)
    for key, images in enumerate(instants):
        for splats, restored in zip(images, tracks.at(packed, key / (KEYS - 1)), strict=True):
            wanted = visible(splats)
            found = in_order(restored, wanted)
            np.testing.assert_allclose(found.means, wanted.means, atol=np.ptp(packed.box, axis=0).max() / 65535)
            np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.51 / 255)
            np.testing.assert_allclose(found.colors, wanted.colors, atol=0.51 * BRIGHTEST / 255)
            ratios = np.log(found.scales / wanted.scales)
            assert np.abs(ratios).max() <= 0.51 * np.ptp(packed.log_scales) / 255
            one, other = (Rotation.from_quat(x.quats, scalar_first=True) for x in (found, wanted))
            assert (one.inv() * other).magnitude().max() < 0.02


def test_values_between_key_instants_are_interpolated(instants):
    packed = quantised(instants)
    before, middle, after = (tracks.at(packed, time / (KEYS - 1))[0] for time in (1, 1.5, 2))
    for name in ("means", "opacities", "colors"):
        ends = getattr(before, name) + getattr(after, name)
        np.testing.assert_allclose(getattr(middle, name), ends / 2, atol=1e-5)
    np.testing.assert_allclose(middle.scales**2, before.scales * after.scales, rtol=1e-4)
    one, half, other = (Rotation.from_quat(x.quats, scalar_first=True) for x in (before, middle, after))
    assert ((one.inv() * half).magnitude() < 0.6 * (one.inv() * other).magnitude() + 1e-3).all()


def test_gaussians_do_not_move_while_they_are_invisible(instants):
    count = len(instants[0][0].means)
    last = [
        tuple(x._replace(opacities=x.opacities * (key == KEYS - 1)) for x in pair) for key, pair in enumerate(instants)
    ]
    packed = quantised(last)
    assert (np.diff(packed.moving.positions[: KEYS - 2].astype(int), axis=0) == 0).all()
    shown = tracks.at(packed, 1.0)[0]
    assert len(shown.means) == count - 1
    in_order(shown, visible(instants[-1][0]))


def test_packed_integers_are_laid_out_as_described(instants):
    packed = quantised(instants)
    data = np.frombuffer(tracks.pack(packed), np.uint8)
    for rows in (*packed.still, *packed.moving, *packed.colors):
        keys, count, channels = rows.shape
        planes, data = np.split(data, [rows.nbytes])
        planes = planes.reshape(channels, rows.itemsize, keys, count)
        steps = (planes.astype(int) * 256 ** np.arange(rows.itemsize)[:, None, None]).sum(1)
        values = steps.cumsum(1).astype(rows.dtype)  # wraps around
        np.testing.assert_array_equal(np.moveaxis(values, 0, -1), rows)
    assert not len(data)
