"""The benchmark cases. A case is a function that returns its figures by name; names end in their unit."""

import dataclasses
import itertools
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.native import NativeBlend
from experiments.benchmarks.scenes import cloud, fine_state, training, video
from experiments.benchmarks.stopwatch import best_of, peak_memory, resident_memory
from l2dgs_jax.config import PRESETS, Config, overrides
from l2dgs_jax.config.overrides import StaticConfig
from l2dgs_jax.data import load_dataset
from l2dgs_jax.model import channels, hexplane, networks
from l2dgs_jax.model.decomposition import decompose
from l2dgs_jax.model.deformation import deform
from l2dgs_jax.model.initialisation import path_knots
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.rasterizer import count_pairs, rasterize
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.training import engine, losses
from l2dgs_jax.training.flows import neighbour_flows
from l2dgs_jax.training.seeds import find_seeds
from l2dgs_jax.training.step import adam
from l2dgs_jax.training.surfaces import find_surfaces
from l2dgs_jax.types import Camera, MovedGaussians, RenderOutput, Scene

Figures = dict[str, float]

DEFAULT = PRESETS["default"]
# Fixed values for the settings that `training.resolve` would derive from the frames; they do not affect the cost.
CONFIG = overrides.replace(
    DEFAULT,
    {
        "model.initial_exponents": (1.01, 9.0),
        "model.initial_illumination": 0.7,
        "model.tone": "linear-light",
        "model.domain": "light",
        "model.exposure": "steady",
        "loss.exposure_level": 0.46,
        "density.stop": 0,
    },
)
VARIANTS = {
    "without_paths": overrides.replace(CONFIG, {"model.tracks": False}),
    "without_gates": overrides.replace(CONFIG, {"model.motion_gate": False}),
    "with_rigidity": overrides.replace(CONFIG, {"loss.rigidity": 1.0}),
}
# Gaussians, width, height.
RASTERIZER_SIZES = {
    "10k_160x96": (10_000, 160, 96),
    "50k_480x270": (50_000, 480, 270),
    "50k_800x450": (50_000, 800, 450),
}
STEP_SIZES = {
    "10k_200x112": (10_000, 200, 112),
    "40k_400x225": (40_000, 400, 225),
    "50k_800x450": (50_000, 800, 450),
}
LARGE_SCENES = (  # Gaussians, frames, width, height
    (40_000, 60, 400, 225),
    (200_000, 60, 400, 225),
    (200_000, 1_000, 400, 225),
    (200_000, 1_000, 800, 450),
    (500_000, 300, 400, 225),
)
FRAME_PLACES = ("memory", "file")


def rasterizer() -> Figures:
    """Forward pass, and forward plus backward pass for all inputs, compared with a C blend of the same lists."""
    figures = {}
    for name, size in RASTERIZER_SIZES.items():
        forward, both, pairs = _rasterizer(*size)
        native = NativeBlend(cloud(*size), *size[1:])
        limit = best_of(native.forward), best_of(native.backward)
        figures |= {
            f"{name}_forward_ms": best_of(forward),
            f"{name}_forward_backward_ms": best_of(both),
            f"{name}_pairs": pairs,
            f"{name}_native_forward_ms": limit[0],
            f"{name}_native_forward_backward_ms": sum(limit),
        }
        figures[f"{name}_over_native"] = figures[f"{name}_forward_backward_ms"] / sum(limit)
    return figures


def growth() -> Figures:
    """Rasterizer, forward plus backward pass: time per million (Gaussian, tile) pairs as the work grows."""
    figures = {}
    for count in (5_000, 20_000, 50_000, 200_000):
        for width, height in ((200, 112), (400, 225), (800, 450)):
            _, both, pairs = _rasterizer(count, width, height)
            milliseconds, name = best_of(both, 5), f"{count // 1000}k_{width}x{height}"
            figures |= {f"{name}_ms": milliseconds, f"{name}_pairs": pairs}
            figures[f"{name}_ms_per_million_pairs"] = 1e6 * milliseconds / pairs
    return figures


def folding() -> Figures:
    """Four scenes drawn with gradients in one vmapped call, compared with one by one; the first has most pairs."""
    width, height, counts = 160, 96, (10_000, 1_000, 1_000, 1_000)
    scenes = [{name: jnp.asarray(x) for name, x in cloud(max(counts), width, height, seed=i).items()} for i in range(4)]
    for scene, count in zip(scenes, counts, strict=True):
        scene["opacities"] = scene["opacities"].at[count:].set(0)
    names = ("means", "quats", "scales", "opacities", "features", "viewmat", "K")
    capacity = next_capacity(max(int(rasterize(*(s[n] for n in names), width, height).pairs) for s in scenes))

    def loss(*x):
        return sum(jnp.vdot(image, image) for image in rasterize(*x, width, height, pair_capacity=capacity)[:3])

    gradient = jax.value_and_grad(loss, range(5))
    one, vmapped = jax.jit(gradient), jax.jit(jax.vmap(gradient))
    apart = [tuple(scene[name] for name in names) for scene in scenes]
    together = jax.tree.map(lambda *x: jnp.stack(x), *apart)
    times = best_of(lambda: [one(*x) for x in apart]), best_of(lambda: vmapped(*together))
    return {"one_by_one_ms": times[0], "vmapped_ms": times[1], "vmapped_over_one_by_one": times[1] / times[0]}


def parts() -> Figures:
    """The parts of a fine step, each with its gradient: 40 k Gaussians, two views of 400x225."""
    width, height = 400, 225
    state, batch = training(40_000, width, height, CONFIG)
    scene, params, cfg = state.scene, state.scene.params, CONFIG.model
    images = jnp.asarray(batch.images)
    move = lambda p: _move(scene._replace(params=p), batch.cameras)
    look = lambda p: hexplane.features(p.hexplane, p.gaussians.means, scene.bounds, batch.cameras.time, cfg)
    moved, field = move(params), jax.jit(look)(params)
    blended = channels.pack(moved.illumination, moved.reflectance, moved.attenuation)
    capacity = next_capacity(_pairs(moved, batch.cameras, width, height))

    def draw(moved, features):
        geometry = (moved.means, moved.quats, moved.scales, moved.opacities)
        camera = (batch.cameras.viewmat, batch.cameras.K)
        return rasterize(*geometry, features, *camera, width, height, pair_capacity=capacity)

    drawn = jax.jit(draw)(moved, blended)

    def judge(features, bafe):
        output = RenderOutput(decompose(features, bafe, cfg), *drawn[1:3], drawn.radii, drawn.pairs, drawn.overflow)
        return losses.total(output, images, CONFIG.loss, 0.9, 1.5)[0]

    def mlps(heads, ocd, field):
        hidden, motion = networks.apply_heads(heads, field)
        return motion, networks.apply_ocd(ocd, hidden)

    optimizer = adam(params, state.adam.schedules, CONFIG)
    update = jax.jit(lambda params, adam: optimizer.update(params, adam, params))
    return {
        "hexplane_ms": _with_gradient(look, params),
        "heads_and_ocd_ms": _with_gradient(mlps, params.heads, params.ocd, field),
        "deform_ms": _with_gradient(move, params),
        "rasterizer_ms": _with_gradient(lambda m, c: draw(m, c)[:3], moved, blended),
        "bafe_ms": _with_gradient(networks.apply_bafe, params.bafe, channels.unpack(drawn.features)[2]),
        "decompose_and_losses_ms": _with_gradient(judge, drawn.features, params.bafe),
        "plane_regularisers_ms": _with_gradient(hexplane.regularisers, params.hexplane),
        "adam_ms": best_of(lambda: update(params, state.adam)),
    }


def step() -> Figures:
    """A whole step of the fine stage as in `train`: loss, gradient and Adam; two views, on two devices if possible."""
    figures = {f"{name}_ms": _step(*size, CONFIG) for name, size in STEP_SIZES.items()}
    size = STEP_SIZES["40k_400x225"]
    figures["40k_400x225_tenth_moving_ms"] = _step(*size, CONFIG, 0.1)
    return figures | {f"40k_400x225_{name}_ms": _step(*size, config) for name, config in VARIANTS.items()}


def rendering() -> Figures:
    """Frames of a moving scene, 40 k Gaussians at 400x225, each at another instant."""
    return _rendering(1.0) | {f"tenth_moving_{name}": rate for name, rate in _rendering(0.1).items()}


def seeding() -> Figures:
    """Work before the first step, on the demo clip: flow between frames, seeds on moving objects, static points."""
    dataset = load_dataset("demo")
    most, knots = dataset.width * dataset.height, path_knots(PRESETS["demo"].model, len(dataset.train.names))
    return {
        "demo_flow_ms": best_of(lambda: neighbour_flows(dataset.train, filled=True), 3),
        "demo_flow_and_seeds_ms": best_of(lambda: find_seeds(dataset.points, dataset.train, knots, most), 3),
        "demo_surfaces_ms": best_of(lambda: find_surfaces(dataset.points, dataset.train, most), 3),
    }


def compiling() -> Figures:
    """Time of a stage's first step in a new process, with the compilation cache empty and then filled."""
    figures = {}
    for stage in ("coarse", "fine"):
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("cold", "cached"):
                figures[f"{stage}_{cache}_s"] = float(_child("first_step", folder, stage))
    return figures


def memory() -> Figures:
    """Peak memory of a process that takes steps with 50 k Gaussians at 800x450, and growth over 1,000 small steps."""
    peak, growth = (float(_child(name)) for name in ("large_steps", "thousand_steps"))
    return {"50k_800x450_peak_gib": peak, "thousand_steps_growth_gib": growth}


def scale() -> Figures:
    """Time of fine steps and peak memory of their process, with the frames in memory and in a file."""
    figures = {}
    for size, place in itertools.product(LARGE_SCENES, FRAME_PLACES):
        milliseconds, peak = _child("training", *map(str, size), place).split()
        name = scale_name(*size, place)
        figures |= {f"{name}_ms": float(milliseconds), f"{name}_peak_gib": float(peak)}
    return figures


def scale_name(count: int, frames: int, width: int, height: int, place: str) -> str:
    """How the names of the figures of one of `LARGE_SCENES` begin."""
    return f"{count // 1000}k_{frames}_frames_{width}x{height}_{place}"


CASES: dict[str, Callable[[], Figures]] = {
    case.__name__: case
    for case in (rasterizer, growth, folding, parts, step, rendering, seeding, compiling, memory, scale)
}


@jax.jit
def _move(scene: Scene, cameras: Camera) -> MovedGaussians:
    return deform(scene, cameras, CONFIG.model, moving=True, sh_degree_active=3)


def _rasterizer(count: int, width: int, height: int) -> tuple[Callable, Callable, int]:
    arrays = {name: jnp.asarray(array) for name, array in cloud(count, width, height).items()}
    learned = tuple(arrays[name] for name in ("means", "quats", "scales", "opacities", "features"))
    camera = (arrays["viewmat"], arrays["K"])
    pairs = int(rasterize(*learned, *camera, width, height).pairs)
    draw = lambda *x: rasterize(*x, *camera, width, height, pair_capacity=next_capacity(pairs))[:3]
    weights = jax.tree.map(lambda x: jax.random.normal(jax.random.key(0), x.shape), jax.eval_shape(draw, *learned))

    def loss(*x):
        return sum(jnp.vdot(w, image) for w, image in zip(weights, draw(*x), strict=True))

    forward, both = jax.jit(draw), jax.jit(jax.value_and_grad(loss, range(5)))
    return lambda: forward(*learned), lambda: both(*learned), pairs


def _with_gradient(function: Callable, *arguments: Any) -> float:
    square = lambda tree: sum(jnp.vdot(x, x) for x in jax.tree.leaves(tree))
    gradient = jax.jit(jax.grad(lambda *x: square(function(*x)), range(len(arguments))))
    return best_of(lambda: gradient(*arguments), 7)


def _pairs(moved: MovedGaussians, cameras: Camera, width: int, height: int) -> int:
    geometry = (moved.means, moved.quats, moved.scales, moved.opacities)
    return int(count_pairs(*geometry, cameras.viewmat, cameras.K, width, height))


def _rendering(moving_share: float) -> Figures:
    state, batch = training(40_000, 400, 225, CONFIG, moving_share)
    renderer = Renderer(state.scene, CONFIG.model, 400, 225, moving=True, sh_degree=3)
    camera = Camera(*(np.asarray(x[0]) for x in batch.cameras))
    cameras = [camera._replace(time=np.float32(t)) for t in np.linspace(0, 1, 40)]
    welllit = lambda camera: np.asarray(renderer.welllit(camera))
    both = lambda camera: np.asarray(renderer(camera).images.lowlight)
    rate = lambda frame: 1e3 * len(cameras) / best_of(lambda: deque(prefetch(frame, cameras), 0), 3)
    return {
        "welllit_frames_per_s": rate(welllit),
        "welllit_and_lowlight_frames_per_s": rate(both),
        "welllit_one_at_a_time_frames_per_s": 1e3 / best_of(lambda: welllit(cameras[0]), 30),
    }


def _step(count: int, width: int, height: int, config: Config, moving_share: float = 1.0) -> float:
    """Milliseconds of one step; restarted several times, because a scene that learns noise needs ever more pairs."""
    return min(best_of(_stepper(count, width, height, config=config, moving_share=moving_share), 5) for _ in range(4))


def _stepper(
    count: int,
    width: int,
    height: int,
    margin: float = 1.3,
    moving: bool = True,
    config: Config = CONFIG,
    moving_share: float = 1.0,
) -> Callable[[], Any]:
    """A function that takes the next training step; the pair buffer holds `margin` times what the first step needs."""
    state, batch = training(count, width, height, config, moving_share)
    views = len(batch.images)
    moved = _move(state.scene, batch.cameras)
    one = lambda tree, view: jax.tree.map(lambda x: x[view : view + 1], tree)
    pairs = [_pairs(one(moved, view), one(batch.cameras, view), width, height) for view in range(views)]
    shares = devices.shares(views)
    mesh = devices.mesh(views=shares)
    capacity = next_capacity(margin * np.reshape(pairs, (shares, -1)).sum(1).max())
    alone = lambda tree: jax.tree.map(lambda x: x[None], tree)
    states = devices.shard(alone(jax.tree.map(jnp.array, state)), mesh, devices.MEMBERS)
    batches = devices.shard(alone(batch), mesh, devices.MEMBERS, devices.VIEWS)
    step = int(state.step)

    def take():
        nonlocal states, step
        states, report, _ = engine.train_steps(
            states, batches, {}, step, config=StaticConfig(config), moving=moving, pair_capacity=capacity, mesh=mesh
        )
        step += 1
        if report.overflow or not report.finite:
            raise RuntimeError("the measured step was refused")
        return report

    return take


def _child(name: str, *arguments: str) -> str:
    """The last line that a function of this module prints in a process of its own."""
    program = (
        "import sys; from l2dgs_jax.runtime.devices import one_per_core; one_per_core(); "
        f"from experiments.benchmarks import cases; cases._{name}(*sys.argv[1:])"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], check=True, capture_output=True, text=True)
    return done.stdout.splitlines()[-1]


def _first_step(folder: str, stage: str) -> None:
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    take = _stepper(7_000, 200, 112, margin=2, moving=stage == "fine")
    start = time.perf_counter()
    take()
    print(time.perf_counter() - start)


def _large_steps() -> None:
    take = _stepper(50_000, 800, 450)
    for _ in range(5):
        take()
    print(peak_memory())


def _thousand_steps() -> None:
    take = _stepper(1_000, 96, 64, margin=4)
    for _ in range(100):
        take()
    before = resident_memory()
    for _ in range(1000):
        take()
    print(resident_memory() - before)


def _training(count: str, frames: str, width: str, height: str, place: str) -> None:
    dataset = video(int(count), int(width), int(height), int(frames), in_file=place == "file")
    config = dataclasses.replace(CONFIG, coarse_steps=0, fine_steps=6)
    member = engine.Member(dataset.train, config, fine_state(dataset, config))
    mesh = devices.mesh(views=devices.shares(config.batch_size))
    times = [time.perf_counter() for _ in engine.run([member], mesh=mesh)]
    print(1e3 * min(np.diff(times)), peak_memory())
