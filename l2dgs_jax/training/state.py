"""What a training step reads and writes."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from l2dgs_jax.config import Config
from l2dgs_jax.model.initialisation import pad_rows
from l2dgs_jax.training import optimizer
from l2dgs_jax.training.densification import GrowthStats
from l2dgs_jax.types import Camera, Scene, SceneParams


class Batch(NamedTuple):
    """The views of one step.

    Attributes:
        cameras: of the views.
        images: sRGB in [0, 1].
        frames: indices of the training frames whose images they show, warped for views between frames.
        valid: pixels to learn from; None for all.
        depths: as in `Split`, 0 where unknown or not to be learned; None if the scene has none.
    """

    cameras: Camera
    images: Float[Array, "*S V H W 3"]
    frames: Int[Array, "*S V"]
    valid: Bool[Array, "*S V H W"] | None = None
    depths: Float[Array, "*S V H W"] | None = None


class TrainState(NamedTuple):
    """All that a step reads and writes, and all that a checkpoint holds. `step` counts finished steps."""

    scene: Scene
    adam: optimizer.AdamState
    stats: GrowthStats
    step: Int[Array, "*S"]


class StepReport(NamedTuple):
    """What a step found. The state is unchanged if the pair buffer overflowed or a gradient was not finite.

    Attributes:
        loss: the sum of all terms with their weights (Eq. 15, regularisers and terms that the paper does not have).
        terms: each term, unweighted.
        psnr: of the low-light estimate against the input, dB, before the step.
        pairs: (Gaussian, tile) pairs that the step needs; if views are spread over devices, the most on any of them.
        overflow: whether they did not fit into the pair buffer.
        finite: whether loss and gradient are finite.
    """

    loss: Float[Array, "*S"]
    terms: dict[str, Float[Array, "*S"]]
    psnr: Float[Array, "*S"]
    pairs: Int[Array, "*S"]
    overflow: Bool[Array, "*S"]
    finite: Bool[Array, "*S"]


def randomness(state: TrainState, config: Config) -> PRNGKeyArray:
    """The key of all that is random at this step."""
    return jax.random.fold_in(jax.random.key(config.seed), state.step)


def with_capacity(state: TrainState, capacity: int, path_capacity: int = 0) -> TrainState:
    """The same state with dead rows appended up to `capacity` and unused paths up to `path_capacity`."""
    pad = partial(pad_rows, capacity=capacity)

    def padded(params: SceneParams) -> SceneParams:
        paths = jax.tree.map(lambda rows: pad_rows(rows, max(len(rows), path_capacity)), params.paths)
        return map_gaussians(pad, params)._replace(paths=paths)

    alive, path_of = jax.tree.map(pad, (state.scene.alive, state.scene.path_of))
    return TrainState(
        scene=state.scene._replace(params=padded(state.scene.params), alive=alive, path_of=path_of),
        adam=state.adam._replace(mu=padded(state.adam.mu), nu=padded(state.adam.nu)),
        stats=jax.tree.map(pad, state.stats),
        step=state.step,
    )


def map_gaussians(function: Callable[[Array], Array], params: SceneParams) -> SceneParams:
    """`params`, or moments of them, with a function applied to every array of the Gaussians."""
    return params._replace(gaussians=jax.tree.map(function, params.gaussians))
