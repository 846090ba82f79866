"""A self-contained page that plays a moving scene in a browser, without a server or a network."""

import base64
import html
import zlib
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from l2dgs_jax.cameras import camera_centres, median_depth
from l2dgs_jax.cameras.geometry import mean_up
from l2dgs_jax.cameras.paths import centre_of_attention, is_path
from l2dgs_jax.errors import UserError
from l2dgs_jax.exporters import tracks as tracks_of
from l2dgs_jax.exporters.baking import Image, background, closeness, near_plane
from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.exporters.tracks import Tracks
from l2dgs_jax.kernels.tiles import MAX_ALPHA, MIN_ALPHA
from l2dgs_jax.rasterizer.projection import EPS_2D, FIELD_MARGIN
from l2dgs_jax.runs import Run
from l2dgs_jax.runtime.pages import filled, script_json
from l2dgs_jax.types import Camera

IMAGES: tuple[Image, ...] = ("welllit", "lowlight")
CHECKED_INSTANTS = 5  # at which a page is compared with the exact images
DEPTH_CAMERAS = 16  # training cameras from which the nearest depth of each Gaussian is taken
SUMMARY = "The well-lit scene as it moves, reconstructed from a dark video by l2dgs_jax."
INFORMATION = """<p>{count:,} Gaussians, {still:,} of which keep still, at {keys} key instants. Here a Gaussian has one
colour, the same from everywhere, where the model blends illumination and reflectance apart; and between key instants
all is interpolated. Against the model's own images, halfway between key instants, those of this page have a PSNR of
{scores}.</p>"""


def pixel_sizes(cameras: Camera, instants: list[tuple[Splats, ...]], nearest: float) -> Float[np.ndarray, " N"]:
    """For each Gaussian, the size of a pixel of the nearest camera at its depth, world units; 0 if none sees it.

    Args:
        cameras: F cameras.
        instants: the Gaussians at some instants.
        nearest: depth beyond which Gaussians are drawn, world units.
    """
    sizes = np.full(len(instants[0][0].means), np.inf)
    for i in range(0, len(cameras.time), max(len(cameras.time) // DEPTH_CAMERAS, 1)):
        row, focal = np.asarray(cameras.viewmat[i, 2]), cameras.K[i, 0, 0]
        for splats in instants:
            depths = splats[0].means @ row[:3] + row[3]
            sizes = np.minimum(sizes, np.where(depths > nearest, depths / focal, np.inf))
    return np.where(np.isfinite(sizes), sizes, 0)


def compare(run: Run, tracks: Tracks) -> Float[np.ndarray, "T I"]:
    """PSNR of a page's images of each kind against the exact ones, dB, halfway between some of the key instants."""
    spans = len(tracks.moving.positions) - 1
    times = (np.unique(np.linspace(0, spans - 1, CHECKED_INSTANTS).round()) + 0.5) / spans

    def at_instant(time: float) -> list[float]:
        shown = zip(tracks_of.at(tracks, time), IMAGES, strict=True)
        return [closeness(run, splats, time, image) for splats, image in shown]

    return np.array([at_instant(time) for time in times.tolist()])


def page(run: Run, tracks: Tracks, scores: Float[np.ndarray, "T I"], seconds: float) -> str:
    """The page as HTML.

    Args:
        run: the run that it shows.
        tracks: its Gaussians, in the colours of `IMAGES`.
        scores: see `compare`.
        seconds: how long the clip takes.

    Raises:
        UserError: no Gaussian lies in front of a training camera.
    """
    source = resources.files("l2dgs_jax.exporters") / "player"
    read = lambda *names: "\n".join((source / name).read_text("utf-8").strip() for name in names)
    return filled(
        read("page.html"),
        title=html.escape(run.dataset.name),
        summary=SUMMARY,
        information=_information(tracks, scores),
        style=read("style.css"),
        description=script_json(_description(run, tracks, seconds)),
        data=base64.b64encode(zlib.compress(tracks_of.pack(tracks), 9)).decode(),
        splat_vertex_shader=read("splat.vert"),
        splat_fragment_shader=read("splat.frag"),
        screen_vertex_shader=read("screen.vert"),
        screen_fragment_shader=read("screen.frag"),
        sorter=read("sorter.js"),
        scripts=read("scene.js", "view.js", "renderer.js", "controls.js", "player.js"),
    )


def _information(tracks: Tracks, scores: Float[np.ndarray, "T I"]) -> str:
    keys, still = len(tracks.moving.positions), tracks.still.positions.shape[1]
    names = ("well lit", "as filmed")
    values = zip(names, scores.mean(0), scores.min(0), strict=True)
    return INFORMATION.format(
        count=still + tracks.moving.positions.shape[1],
        keys=keys,
        still=still,
        scores=", and ".join(f"{mean:.1f} dB {name} (at worst {least:.1f})" for name, mean, least in values),
    )


def _description(run: Run, tracks: Tracks, seconds: float) -> dict[str, Any]:
    """What the player needs besides the tracks, as JSON values."""
    dataset, cameras = run.dataset, run.dataset.train.cameras
    try:
        depth = median_depth(cameras, tracks_of.at(tracks, 0.5)[0].means)
    except ValueError:
        raise UserError(f"{run.name}: no Gaussian is in front of a training camera; expected a trained scene") from None
    viewmats = np.asarray(cameras.viewmat, np.float64)
    centres = camera_centres(viewmats)
    distances = ((centre_of_attention(cameras, depth) - centres) * viewmats[:, 2, :3]).sum(-1)
    return {
        "keys": len(tracks.moving.positions),
        "still": tracks.still.positions.shape[1],
        "moving": tracks.moving.positions.shape[1],
        "images": IMAGES,
        "box": _rounded(tracks.box),
        "logScales": _rounded(tracks.log_scales),
        "brightest": tracks.brightest,
        "background": background(run),
        "nearPlane": near_plane(run),
        "fieldMargin": FIELD_MARGIN,
        "dilation": EPS_2D,
        "minAlpha": MIN_ALPHA,
        "maxAlpha": MAX_ALPHA,
        "width": dataset.width,
        "height": dataset.height,
        "seconds": seconds,
        "up": _rounded(mean_up(viewmats)),
        "path": is_path(cameras),
        "cameras": [
            {
                "time": _rounded(cameras.time[i]),
                "axes": _rounded(viewmats[i, :3, :3]),
                "centre": _rounded(centres[i]),
                "focal": _rounded(cameras.K[i, [0, 1], [0, 1]]),
                "principal": _rounded(cameras.K[i, :2, 2]),
                "distance": _rounded(max(distances[i], depth / 4)),
            }
            for i in np.argsort(cameras.time, kind="stable").tolist()
        ],
    }


def _rounded(values: Any) -> Any:
    """Values rounded to the digits that single precision holds, as lists."""
    array = np.asarray(values, np.float64)
    texts = np.array([float(f"{value:.8g}") for value in array.ravel()])
    return texts.reshape(array.shape).tolist()
