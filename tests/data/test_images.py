"""Picture files of every kind are read as sRGB values in [0, 1]."""

import resource

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from scenes import mark_orientation, write_image, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import assembly, images, lens
from l2dgs_jax.errors import DISK_FULL, UserError


def write(path, pixels, orientation=1, **attributes):
    kind = {"uint8": "uint8", "float16": "half", "float32": "float"}[pixels.dtype.name]
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.alpha_channel = pixels.shape[2] - 1 if pixels.shape[2] in (2, 4) else -1
    spec.attribute("Orientation", orientation)
    for name, value in attributes.items():
        spec.attribute(name, value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(pixels)
    file.close()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".jpg", ".jpeg", ".JPG"])
def test_integer_formats_are_read(tmp_path, suffix):
    smooth = np.linspace(20, 235, 24).astype(np.uint8)
    pixels = np.stack(np.broadcast_arrays(smooth[:, None], smooth[None], smooth[::-1, None]), -1)
    write(tmp_path / f"a{suffix}", np.ascontiguousarray(pixels))
    exact = suffix in (".png", ".tif", ".bmp")
    np.testing.assert_allclose(images.read_image(tmp_path / f"a{suffix}"), pixels / 255, atol=1e-6 if exact else 0.05)
    assert images.read_header(tmp_path / f"a{suffix}") == ((24, 24), 1, False)


@pytest.mark.parametrize(("suffix", "kind"), [(".exr", np.float32), (".exr", np.float16), (".hdr", np.float32)])
def test_linear_light_becomes_srgb(tmp_path, suffix, kind):
    light = np.array([0, 0.001, 0.0031308, 0.02, 0.18, 0.5, 1, 7], kind)
    write(tmp_path / f"a{suffix}", np.repeat(light[None, :, None], 3, -1))
    expected = [0, 0.01292, 0.04045, 0.15204, 0.46136, 0.73536, 1, 1]
    tolerance = 0.01 if suffix == ".hdr" else 1e-3
    np.testing.assert_allclose(images.read_image(tmp_path / f"a{suffix}")[0, :, 1], expected, atol=tolerance)
    assert images.read_header(tmp_path / f"a{suffix}").linear


def test_floats_marked_as_srgb_are_not_converted(tmp_path):
    write(tmp_path / "a.tif", np.full((4, 5, 3), 0.25, np.float32), **{"oiio:ColorSpace": "sRGB"})
    assert not images.read_header(tmp_path / "a.tif").linear
    np.testing.assert_allclose(images.read_image(tmp_path / "a.tif"), 0.25)


def test_linear_frames_are_mentioned_once(tmp_path):
    scene = write_nerfies(tmp_path)
    assert data.load_dataset(scene).notes == ()
    for path in (scene / "rgb" / "1x").iterdir():
        write(path.with_suffix(".exr"), images.read_image(path) ** 2.2)
        path.unlink()
    assert data.load_dataset(scene).notes == (assembly.LINEAR_NOTE,)


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_without_its_end_is_refused_but_not_one_with_more_behind_it(tmp_path, progressive):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    whole = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    thumbnail = b"\xff\xe1" + (len(whole) + 2).to_bytes(2, "big") + whole  # a segment that holds a whole picture
    path = tmp_path / "a.jpg"
    whole = whole[:2] + b"\xff\xff" + thumbnail + whole[2:]  # after bytes that fill, as a file may have them
    path.write_bytes(whole + b"\xff\xda and a film, as some phones append it")
    np.testing.assert_allclose(images.read_image(path).mean(), 0.5, atol=0.03)
    for part in (0.99, 0.8):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(UserError, match=r"a\.jpg: expected a readable picture"):
            images.read_image(path)


def test_values_that_are_not_finite_are_refused(tmp_path):
    pixels = np.zeros((4, 5, 3), np.float32)
    pixels[1, 2] = np.nan
    write(tmp_path / "a.exr", pixels)
    with pytest.raises(UserError, match=r"a\.exr: holds NaN or infinite values; expected"):
        images.read_image(tmp_path / "a.exr")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_upright(tmp_path, orientation):
    upright = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    turns = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}  # quarter turns that the stored picture needs, clockwise
    flipped = upright[:, ::-1] if orientation in (2, 4, 5, 7) else upright
    stored = np.rot90(flipped, turns[orientation])
    write(tmp_path / "a.tif", np.ascontiguousarray(stored), orientation)
    np.testing.assert_allclose(images.read_image(tmp_path / "a.tif"), upright / 255, atol=1e-6)
    assert images.read_header(tmp_path / "a.tif") == ((6, 4), orientation, False)
    viewer = oiio.ImageBuf(str(tmp_path / "a.tif"))
    np.testing.assert_array_equal(oiio.ImageBufAlgo.reorient(viewer).get_pixels(oiio.UINT8), upright)


@pytest.mark.parametrize("layout", ["transforms", "llff"])
@pytest.mark.parametrize("orientation", [3, 6])
def test_photos_that_fit_their_cameras_are_not_turned(tmp_path, layout, orientation):
    data.LAYOUTS[layout].write(data.load_dataset(write_nerfies(tmp_path / "nerfies", 9)), tmp_path / "scene")
    expected = data.load_dataset(tmp_path / "scene").train.images
    for path in (tmp_path / "scene" / "images").iterdir():
        mark_orientation(path, orientation)
    assert np.array_equal(data.load_dataset(tmp_path / "scene").train.images, expected)


def test_a_turned_photo_of_the_wrong_size_is_named_as_such(tmp_path):
    scene = write_nerfies(tmp_path)
    write(scene / "rgb" / "1x" / "000003.png", np.zeros((24, 32, 3), np.uint8), 6)
    with pytest.raises(UserError, match=r"000003\.png: the picture is 24x32 pixels once turned as its EXIF"):
        data.load_dataset(scene)


def test_grey_pictures_and_alpha_are_read(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 6, 4), np.uint8)
    for name, channels in (("grey", [0]), ("grey-alpha", [0, 3]), ("rgb", [0, 1, 2]), ("rgba", [0, 1, 2, 3])):
        write(tmp_path / f"{name}.tif", np.ascontiguousarray(pixels[..., channels]), **{"oiio:UnassociatedAlpha": 1})
        image, alpha = images.read_image_and_alpha(tmp_path / f"{name}.tif")
        color = pixels[..., :3] if len(channels) > 2 else pixels[..., [0, 0, 0]]
        np.testing.assert_allclose(image, color / 255, atol=1e-6)
        assert (alpha is None) == (3 not in channels)
        if alpha is not None:
            np.testing.assert_allclose(alpha, pixels[..., 3:] / 255, atol=1e-6)


def test_premultiplied_alpha_is_divided_out(tmp_path):
    pixels = np.zeros((1, 3, 4), np.float32)
    pixels[0] = [[0.25, 0.25, 0.25, 0.5], [0.25, 0.25, 0.25, 0], [0.25, 0.25, 0.25, 1]]
    write(tmp_path / "held.exr", pixels)
    write(tmp_path / "held.tif", pixels, **{"oiio:ColorSpace": "sRGB"})
    write(tmp_path / "beside.tif", pixels, **{"oiio:ColorSpace": "sRGB", "oiio:UnassociatedAlpha": 1})
    for name, alone, over_black in (
        ("held.exr", [0.73536, 0.53710, 0.53710], [0.53710, 0.53710, 0.53710]),  # the middle one glows
        ("held.tif", [0.5, 0.25, 0.25], [0.25, 0.25, 0.25]),
        ("beside.tif", [0.25, 0.25, 0.25], [0.125, 0, 0.25]),
    ):
        np.testing.assert_allclose(images.read_image(tmp_path / name)[0, :, 0], alone, atol=1e-4)
        np.testing.assert_allclose(images.read_over_black(tmp_path / name)[0, :, 0], over_black, atol=1e-4)


def test_alpha_is_written_unassociated(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 6, 4), np.uint8)
    pixels[0, :, 3] = 0
    images.write_image(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]], pixels)


def test_undistortion_moves_a_ramp_to_where_the_lens_says():
    ramp = np.repeat(np.tile(np.linspace(0.1, 0.9, 60, dtype=np.float32), (40, 1))[..., None], 3, -1)
    K = np.array([[50, 0, 30], [0, 50, 20], [0, 0, 1.0]])
    radial = lens.Lens((0.05,))
    x, y = np.meshgrid((np.arange(60) + 0.5 - 30) / 50, (np.arange(40) + 0.5 - 20) / 50)
    columns = 50 * lens.distort(radial, x, y)[0] + 30
    shown = lens.undistort(ramp, K, radial)[..., 0]
    inside = (columns > 3) & (columns < 57)
    np.testing.assert_allclose(shown[inside], (0.1 + 0.8 * (columns - 0.5) / 59)[inside], atol=1e-5)


@pytest.mark.parametrize(("fisheye", "focal"), [(False, 45), (True, 15)])
def test_what_a_barrel_distortion_would_mirror_is_not_seen(fisheye, focal):
    K = np.array([[focal, 0, 50], [0, focal, 30], [0, 0, 1.0]])
    barrel = lens.Lens((-0.25,), fisheye=fisheye)
    x, y = np.meshgrid((np.arange(100) + 0.5 - 50) / focal, (np.arange(60) + 0.5 - 30) / focal)
    r = np.hypot(x, y)
    imaged = lambda r: lens.distort(barrel, r, 0 * r)[0]
    grows = imaged(r + 1e-4) > imaged(r)
    clear = abs(imaged(r + 1e-4) - imaged(r)) > 1e-6
    seen = lens.seen((100, 60), K, barrel)
    assert grows[clear].any()
    assert not grows[clear].all()
    np.testing.assert_array_equal(seen[clear], grows[clear])


def test_an_absurd_lens_gives_finite_values():
    image = np.random.default_rng(0).random((8, 9, 3), np.float32)
    for terms in ((1e300, -1e300), (np.inf,), (-1e9, 1e30)):
        for fisheye in (False, True):
            shown = lens.undistort(
                image, np.array([[9, 0, 4], [0, 9, 4], [0, 0, 1.0]]), lens.Lens(terms, fisheye=fisheye)
            )
            assert np.isfinite(shown).all()


def test_names_with_spaces_and_unicode_are_read(tmp_path):
    write_image(tmp_path / "a b.png", np.zeros((3, 4, 3)))
    (tmp_path / "a b.png").rename(tmp_path / "ein Bild é 日.png")
    assert images.read_image(tmp_path / "ein Bild é 日.png").shape == (3, 4, 3)


def test_area_average_crops_and_averages():
    image = np.random.default_rng(0).random((7, 8, 3), np.float32)
    small = images.area_average(image, 3)
    assert small.shape == (2, 2, 3)
    np.testing.assert_allclose(small[1, 0], image[3:6, :3].mean((0, 1)), rtol=1e-6)


@pytest.mark.parametrize("channels", [None, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_of_any_bit_depth_and_channels_are_written_and_read(tmp_path, dtype, channels):
    shape = (5, 6) if channels is None else (5, 6, channels)
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    if channels == 4:
        pixels[0, :, 3] = 0  # colour under alpha 0 must survive
    write_image(tmp_path / "a.png", pixels)
    expected = np.repeat(pixels[..., None], 3, -1) if channels is None else pixels[..., :3]
    np.testing.assert_allclose(images.read_image(tmp_path / "a.png"), expected / np.iinfo(dtype).max, atol=1e-6)
    assert images.read_header(tmp_path / "a.png") == ((6, 5), 1, False)


def test_values_beyond_the_range_are_clipped(tmp_path):
    write(tmp_path / "a.exr", np.array([[[-0.1, 0.5, 1.5]]], np.float32), **{"oiio:ColorSpace": "sRGB"})
    np.testing.assert_allclose(images.read_image(tmp_path / "a.exr"), [[[0, 0.5, 1]]], atol=1e-3)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".webp"])
def test_a_full_disk_is_reported_and_leaves_the_old_picture(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    images.write_image(path, np.zeros((8, 8, 3), np.float32 if suffix == ".exr" else np.uint8))
    old, large = path.read_bytes(), np.zeros((256, 256, 3), np.float32 if suffix == ".exr" else np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, limits[1]))  # as if no more bytes were free
    try:
        with pytest.raises(UserError, match=rf"a\{suffix}: ") as error:
            images.write_image(path, large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.code == DISK_FULL
    assert path.read_bytes() == old
    assert [*tmp_path.iterdir()] == [path]
