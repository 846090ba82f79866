import struct

import clips
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import write_image

from l2dgs_jax.data import images
from l2dgs_jax.preprocess.capture import brighten, frames, motion, structure


def random_image(seed=0, shape=(40, 60, 3)):
    return np.random.default_rng(seed).random(shape, np.float32)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(0, 10), min_size=1, max_size=300), st.integers(1, 100))
def test_chosen_frames_are_evenly_spaced(scores, count):
    chosen = frames.sample(scores, count)
    assert len(chosen) == min(count, len(scores))
    assert sorted(set(chosen)) == chosen
    assert chosen[0] >= 0
    assert chosen[-1] < len(scores)
    if len(scores) > count:
        even = (np.arange(count) + 0.5) * len(scores) / count - 0.5
        assert np.abs(np.array(chosen) - even).max() <= max(0.5, len(scores) / count / 4) + 1e-9


def test_the_sharpest_of_near_neighbours_is_chosen():
    scores = np.zeros(80)
    scores[[3, 4 + 8, 5 + 16]] = 1
    assert frames.sample(scores.tolist(), 10)[:3] == [3, 12, 21]


def test_blur_lowers_sharpness_and_exposure_does_not_change_it():
    image = cv2.GaussianBlur(random_image(shape=(300, 400, 3)), (0, 0), 1.5)
    blurred = [cv2.GaussianBlur(image, (0, 0), sigma) for sigma in (1.0, 2.0, 4.0)]
    scores = [frames.sharpness(x) for x in (image, *blurred)]
    assert scores == sorted(scores, reverse=True)
    assert frames.sharpness(0.1 * image) == pytest.approx(scores[0], rel=1e-3)


NAMES = {
    "the last number": (["b 9.png", "b 10.png"], [9, 10]),
    "the number that differs": (["IMG_7_v2.png", "IMG_12_v2.png"], [7, 12]),
    "alphabetical order": (["eins.png", "zwei.png"], [0, 1]),
    "Unicode and spaces": (["Küche – 3 ä.png", "Küche – 4 ä.png"], [3, 4]),
}


@pytest.mark.parametrize("case", NAMES)
def test_pictures_of_a_folder_are_numbered_by_name(tmp_path, case):
    names, numbers = NAMES[case]
    for i, name in enumerate(names):
        write_image(tmp_path / name, random_image(i))
    (tmp_path / "notes.txt").write_text("no picture")
    found = frames.scan(tmp_path)
    assert [candidate.number for candidate in found] == numbers
    assert [candidate.origin for candidate in found] == names


def test_frames_of_a_folder_keep_their_pixels(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    target.mkdir()
    write_image(source / "1.png", random_image(1))
    write_image(source / "2.jpg", random_image(2))
    write_image(source / "3.tiff", np.random.default_rng(3).integers(0, 65535, (40, 60, 3), np.uint16))
    found = frames.scan(source)
    frames.extract(source, found, [0, 1, 2], target)
    assert (target / "000001.png").read_bytes() == (source / "1.png").read_bytes()
    for candidate in found:
        expected = images.read_image(source / candidate.origin)
        np.testing.assert_allclose(images.read_image(target / candidate.name), expected, atol=1e-7)


def test_frames_of_a_video_keep_their_pixels_and_instants(tmp_path):
    pictures = [images.to_bytes(random_image(i)) for i in range(6)]
    clips.write_video(tmp_path / "clip.avi", pictures)
    found = frames.scan(tmp_path / "clip.avi")
    assert [candidate.number for candidate in found] == [0, 40, 80, 120, 160, 200]
    frames.extract(tmp_path / "clip.avi", found, [1, 4], tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["000040.png", "000160.png"]
    for i in (1, 4):
        np.testing.assert_array_equal(images.to_bytes(images.read_image(tmp_path / found[i].name)), pictures[i])


def test_times_increase_though_one_is_repeated_and_frames_are_numbered_without_times():
    assert frames._increasing([0, 33, 66, 400, 400, 800]) == [0, 33, 66, 400, 401, 800]
    assert frames._increasing([0, 0, 0, 0]) == [0, 1, 2, 3]
    assert frames._increasing([7]) == [7]


def test_a_rotated_video_is_turned_upright(tmp_path):
    path = tmp_path / "phone.mp4"
    clips.write_video(path, [images.to_bytes(random_image(i, (32, 64, 3))) for i in range(3)], "mp4v")
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    frames.extract(path, frames.scan(path), [0], tmp_path)
    assert images.read_header(tmp_path / "000000.png").size == (32, 64)


def test_brightening_keeps_the_order_of_levels_and_the_size():
    ramp = np.repeat(np.linspace(0, 0.3, 256, dtype=np.float32)[None, :, None], 3, -1).repeat(20, 0)
    tone = brighten.tone_for([ramp])
    bright = brighten.brighten(ramp, tone)
    assert bright.shape == ramp.shape[:2]
    assert np.all(np.diff(bright[10].astype(int)) >= 0)
    assert bright.mean() > 255 * ramp.mean()


@pytest.mark.parametrize("light", [0.02, 0.1, 0.5, 1.0])
def test_clips_of_any_darkness_are_brightened_alike(light):
    image = light * random_image() ** 2
    tone = brighten.tone_for([image])
    assert 0.25 < brighten.brighten(image, tone).mean() / 255 < 0.5
    assert (tone.smoothing > 0) == (light < 0.8)


def test_well_lit_clips_are_not_changed():
    image = np.repeat(0.2 + 0.8 * random_image()[..., :1], 3, axis=-1)
    tone = brighten.tone_for([image])
    assert tone == (1.0, 1.0, 0.0)
    np.testing.assert_allclose(brighten.brighten(image, tone) / 255, frames.luma(image), atol=0.51 / 255)


def grey_clip(count, **options):
    pictures, _, squares = clips.clip(count, **options)
    return [motion.small(brighten.brighten(p, brighten.tone_for(pictures))) for p in pictures], squares


def test_moving_regions_are_found_and_static_ones_are_not():
    pictures, squares = grey_clip(15, reach=0.4, light=0.3)
    masks = list(motion.moving_regions(pictures))
    found = np.mean([(mask & square).sum() / square.sum() for mask, square in zip(masks, squares, strict=True)])
    wrong = np.mean([mask[~square].mean() for mask, square in zip(masks, squares, strict=True)])
    assert found > 0.8
    assert wrong < 0.1
    without_square = motion.moving_regions(grey_clip(15, reach=0.4, light=0.3, block=False)[0])
    assert np.mean([mask.mean() for mask in without_square]) < 0.05


def test_camera_shift_is_that_of_the_camera_not_of_objects():
    assert motion.camera_shift(grey_clip(6, reach=0.0, light=0.1)[0]) < 0.5 * motion.STILL_BELOW
    assert motion.camera_shift(grey_clip(6, reach=0.05, light=0.1)[0]) > 2 * motion.STILL_BELOW
    assert motion.camera_shift([np.zeros((20, 20), np.uint8)]) == 0


@given(st.integers(2, 2000))
def test_every_frame_is_matched_with_its_neighbours_and_far_ones(count):
    offsets = structure.offsets(count)
    assert offsets[: structure.OVERLAP] == list(range(1, structure.OVERLAP + 1))
    assert sorted(set(offsets)) == offsets
    assert 2 * offsets[-1] >= count or offsets[-1] == structure.OVERLAP
