"""Structure from motion with COLMAP (Schönberger and Frahm, CVPR 2016), through pycolmap.

Every step stores its results in one database, so that it continues where an earlier call was stopped.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from l2dgs_jax.runtime.extras import extra

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

LARGEST_SIDE = 1600  # of the pictures that features are found in, pixels
OVERLAP = 10  # each frame is matched with so many next ones, and with those 2, 4, 8 ... times as far away
SMALLEST_MODEL = 3  # frames
FEWEST_POINTS = 50  # in a model
ENOUGH_FRAMES = 0.9  # share of the frames with a pose at which the first attempt is accepted


@dataclass(frozen=True)
class Workplace:
    """The files that structure from motion uses.

    Attributes:
        frames: folder of the frames, from which points get their colours.
        copies: folder of brightened copies, of the same names and size, in which features are found.
        masks: folder of pictures `<name>.png` that are 0 where features are ignored.
        database: file of COLMAP's database.
        models: folder for the reconstructions.
        threads: how many to use.
    """

    frames: Path
    copies: Path
    masks: Path
    database: Path
    models: Path
    threads: int


def pycolmap() -> Any:
    """The package pycolmap, with only errors logged.

    Raises:
        UserError: it is not installed.
    """
    package = extra("pycolmap", "sfm", "structure from motion")
    package.logging.minloglevel = int(package.logging.ERROR)
    return package


def find_features(workplace: Workplace, names: Sequence[str], camera_model: CameraModel) -> None:
    """Find SIFT features in every frame; all frames share one camera of the given model."""
    colmap = pycolmap()
    extraction = colmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, workplace.threads, LARGEST_SIDE
    reader = colmap.ImageReaderOptions()
    reader.camera_model, reader.mask_path = camera_model, workplace.masks
    with colmap.Database.open(workplace.database) as database:
        done = {image.name for image in database.read_all_images() if database.num_keypoints_for_image(image.image_id)}
        if database.num_cameras():
            reader.existing_camera_id = database.read_all_cameras()[0].camera_id
    todo = [name for name in names if name not in done]
    with tqdm(total=len(names), initial=len(done), desc="features", unit="frame", dynamic_ncols=True) as bar:
        for some in _chunks(todo, workplace.threads):
            colmap.extract_features(
                workplace.database,
                workplace.copies,
                image_names=some,
                camera_mode=colmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
                device=colmap.Device.cpu,
            )
            if reader.existing_camera_id < 0:
                with colmap.Database.open(workplace.database) as database:
                    reader.existing_camera_id = database.read_all_cameras()[0].camera_id
            bar.update(len(some))


def match_features(workplace: Workplace, names: Sequence[str]) -> None:
    """Match every frame with frames near it in time and some far away, and verify the matches geometrically."""
    colmap = pycolmap()
    matching = colmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, workplace.threads
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pairing = colmap.ImportedPairingOptions()
    pairing.match_list_path = workplace.database.with_name("pairs.txt")
    for i in tqdm(range(len(names) - 1), desc="matching", unit="frame", dynamic_ncols=True):
        # COLMAP skips pairs that are matched already.
        partners = (names[i + offset] for offset in offsets(len(names)) if i + offset < len(names))
        pairing.match_list_path.write_text("".join(f"{names[i]} {partner}\n" for partner in partners))
        colmap.match_image_pairs(
            workplace.database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=colmap.Device.cpu,
        )


def offsets(count: int) -> list[int]:
    """Distances between matched frames in a clip of `count` frames."""
    offsets = list(range(1, OVERLAP + 1))
    while (further := 2 * offsets[-1]) < count:
        offsets.append(further)
    return offsets


def count_pairs(workplace: Workplace) -> tuple[int, int]:
    """How many pairs of frames were verified, and how many of them show parallax, so that no homography fits them."""
    kinds = pycolmap().TwoViewGeometryConfiguration
    flat = {int(kind) for kind in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)}
    with pycolmap().Database.open(workplace.database) as database:
        found = [int(pair.config) for pair in database.read_two_view_geometries()[1] if len(pair.inlier_matches)]
    return len(found), sum(kind not in flat for kind in found)


def reconstruct(workplace: Workplace, count: int, camera_model: CameraModel) -> Any:
    """Find poses and points.

    The first attempt keeps lens distortion at zero until the final bundle adjustment, because few frames determine it
    badly, which then harms all later ones. If too few of the `count` frames get a pose, a second attempt estimates
    distortion from the start, if the camera model has any, and the better reconstruction is taken.

    Returns:
        The largest model, a `pycolmap.Reconstruction`; None if there is none.
    """
    first = _map(workplace, count, distorted=False)
    enough = first is not None and first.num_reg_images() >= ENOUGH_FRAMES * count
    if enough or camera_model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return first
    models = [model for model in (first, _map(workplace, count, distorted=True)) if model is not None]
    return max(models, key=_size, default=None)


def _map(workplace: Workplace, count: int, distorted: bool) -> Any:
    colmap = pycolmap()
    colmap.set_random_seed(0)
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = workplace.threads, 0, SMALLEST_MODEL
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = distorted
    workplace.models.mkdir(exist_ok=True)
    description = "poses, with distortion" if distorted else "poses"
    with tqdm(total=count, desc=description, unit="frame", dynamic_ncols=True) as bar:

        def begin() -> None:  # called again when an attempt is given up for another initial pair of frames
            bar.reset()
            bar.update(2)

        models = colmap.incremental_mapping(
            workplace.database,
            workplace.frames,
            workplace.models,
            options,
            initial_image_pair_callback=begin,
            next_image_callback=bar.update,
        )
    if not models:
        return None
    model = max(models.values(), key=_size)
    if model.num_points3D() < FEWEST_POINTS:
        return None
    _adjust(model, workplace.threads)
    return model


def _adjust(model: Any, threads: int) -> None:
    """Refine poses, points, focal length and distortion together."""
    colmap = pycolmap()
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    config = colmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _size(model: Any) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _chunks(names: Sequence[str], size: int) -> Iterator[list[str]]:
    for start in range(0, len(names), size):
        yield list(names[start : start + size])
