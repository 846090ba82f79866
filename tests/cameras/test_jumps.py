"""Things that move farther from frame to frame than optical flow from coarse to fine follows."""

import cv2
import numpy as np
import pytest

from l2dgs_jax.cameras.flow import optical_flow
from l2dgs_jax.cameras.jumps import follow_jumps, unexplained

HEIGHT, WIDTH, SIDE = 96, 128, 16
COLUMN, ROW = 50, 40  # of the thing in the first frame


def texture(rng, height, width, cell):
    return cv2.resize(
        rng.uniform(0, 255, (height // cell, width // cell)), (width, height), interpolation=cv2.INTER_CUBIC
    )


def frames(right, down, scale=1, seed=0):
    """A small textured thing that jumps over a textured wall, twice seen, with noise."""
    rng = np.random.default_rng(seed)
    wall, thing = 60 + 0.5 * texture(rng, HEIGHT, WIDTH, 8), texture(rng, SIDE, SIDE, 4)
    for column, row in ((COLUMN, ROW), (COLUMN + right, ROW + down)):
        frame = wall.copy()
        frame[row : row + SIDE, column : column + SIDE] = thing
        frame = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        frame = cv2.GaussianBlur(frame, (0, 0), 1.0) + rng.normal(0, 2, frame.shape)
        yield np.clip(frame, 0, 255).astype(np.uint8)


def followed(first, second, shortest=0.0):
    flow = optical_flow(first, second)
    return flow, *follow_jumps(first, second, flow, unexplained(first, second, flow), shortest)


@pytest.mark.parametrize("scale", [1, 3])
@pytest.mark.parametrize("jump", [(20, -7), (-18, 20), (16, 4)])
def test_a_small_thing_is_found_where_it_jumps_to(jump, scale):
    first, second = frames(*jump, scale)
    flow, found, jumps = followed(first, second)
    inner = np.s_[scale * (ROW + 3) : scale * (ROW + SIDE - 3), scale * (COLUMN + 3) : scale * (COLUMN + SIDE - 3)]
    error = lambda x: np.median(np.linalg.norm(x[inner] - scale * np.array(jump), axis=-1))
    assert error(flow) > 0.5 * scale * np.hypot(*jump)  # otherwise there is nothing to be shown
    assert error(found) < 0.5 * scale
    assert jumps[inner].all()
    assert jumps.sum() < 3 * (scale * SIDE) ** 2  # what it uncovers and hides may find something similar


def test_where_flow_follows_there_are_no_jumps():
    flow, found, jumps = followed(*frames(4, 2))
    assert not jumps.any()
    assert np.abs(found - flow).mean() < 0.1


def test_jumps_have_the_length_asked_for():
    first, second = frames(20, -7)
    flow, found, jumps = followed(first, second, shortest=15.0)
    inner = np.s_[ROW + 3 : ROW + SIDE - 3, COLUMN + 3 : COLUMN + SIDE - 3]
    assert jumps[inner].all()
    assert np.linalg.norm(found - flow, axis=-1)[jumps].min() > 10
    assert not followed(first, second, shortest=40.0)[2].any()


def test_what_appears_is_not_found():
    rng = np.random.default_rng(3)
    first, second = (np.ascontiguousarray(x) for x in frames(0, 0))
    second[ROW : ROW + SIDE, COLUMN : COLUMN + SIDE] = rng.uniform(0, 255, (SIDE, SIDE)).astype(np.uint8)
    _, _, jumps = followed(first, second)
    assert jumps.mean() < 0.01


@pytest.mark.parametrize("shape", [(96, 128), (8, 8), (12, 200)])
def test_frames_that_have_nothing_in_common_or_are_smaller_than_a_patch(shape):
    first, second = np.random.default_rng(0).integers(0, 255, (2, *shape), np.uint8)
    everywhere = np.ones(shape, bool)
    found, jumps = follow_jumps(first, second, np.zeros((*shape, 2), np.float32), everywhere, 0.0)
    assert np.isfinite(found).all()
    assert jumps.mean() < 0.05


def test_unexplained_are_changes_and_unknown_flow():
    first, second = frames(0, 0)
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    assert not unexplained(first, second, flow).any()
    second[:20, :20] = 255
    flow[-10:, -10:] = np.nan
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[:20, :20] = expected[-10:, -10:] = True
    found = unexplained(first, second, flow)
    assert found[expected].mean() > 0.98
    assert found[~expected].mean() < 0.02
    assert unexplained(first, second, np.full_like(flow, np.nan)).all()
