"""How much neighbouring Gaussians that move change their distances: a prior that they move like parts of bodies."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import compaction
from l2dgs_jax.model.deformation import deform, has_path, length_unit, openness
from l2dgs_jax.types import Camera, Scene

DRAWN = 1024  # Gaussians that are looked at in one step
NEIGHBOURS = 4  # of each
RADIUS = 0.05  # distance at which the weight of a neighbour has fallen to 1/e, in units of length
SPANS = (0.02, 0.1)  # shortest and longest time between the two instants, as shares of the clip
SOFTNESS = 1e-4  # in units of length: the gradient of a shorter distance is small, where that of 0 would be undefined
PSEUDO_COUNT = 1  # weight of no change in the mean, so that a few faint pairs do not count as much as many


def rigidity(scene: Scene, cfg: ModelConfig, key: PRNGKeyArray) -> Float[Array, ""]:
    """Mean change of the distances between neighbours from one random instant to another, in units of length.

    After the local isometry of Dynamic 3D Gaussians (arXiv 2308.09713), but between two near instants, and for a random
    sample of the Gaussians. They are drawn in proportion to their motion gates; those on paths as if theirs were open,
    if their lifetimes contain both instants. Gradients flow to the centres, the gates, the paths and the motion field.

    Args:
        scene: the scene; one without motion gates is sampled evenly.
        cfg: shape of the scene.
        key: of the sample and the instants.
    """
    for_sample, for_first, for_span = jax.random.split(key, 3)
    gaussians, dtype = scene.params.gaussians, scene.params.gaussians.means.dtype
    span = jax.random.uniform(for_span, (), dtype, *SPANS)
    first = (1 - span) * jax.random.uniform(for_first, (), dtype)
    instants = jnp.stack([first, first + span])
    weights = 1 if gaussians.gate is None else openness(gaussians.gate, cfg)
    log_weights = jnp.log(jnp.where(scene.alive, weights, 0))
    if gaussians.lifetimes is not None:
        born, dies = gaussians.lifetimes.T
        present = (born <= instants[0]) & (instants[1] <= dies)
        log_weights = jnp.where(
            scene.alive & has_path(gaussians.lifetimes), jnp.where(present, 0, -jnp.inf), log_weights
        )
    # The highest sums are draws without replacement (arXiv 1903.06059).
    scores = jax.lax.stop_gradient(log_weights) + jax.random.gumbel(for_sample, log_weights.shape, dtype)
    subset = compaction.highest(scores, min(DRAWN, len(scores)))
    drawn = jax.tree.map(lambda values: compaction.select(values, subset, 0), gaussians)
    anywhere = lambda size: jnp.broadcast_to(jnp.eye(size, dtype=dtype), (2, size, size))
    alive, path_of = jax.tree.map(lambda rows: rows[subset.rows], (scene.alive, scene.path_of))
    moved = deform(
        scene._replace(params=scene.params._replace(gaussians=drawn), alive=alive, path_of=path_of),
        Camera(anywhere(4), anywhere(3), instants),  # motion does not depend on where the camera is
        cfg,
        moving=True,
        sh_degree_active=0,
    )
    return change_of_distances(moved.means / length_unit(scene.extent, cfg), moved.opacities)


def change_of_distances(means: Float[Array, "2 N 3"], opacities: Float[Array, "2 N"]) -> Float[Array, ""]:
    """Mean |change of distance| to the nearest neighbours between two instants; 0 if all move as one rigid body.

    Neighbours are the nearest at the first instant of those that are visible at both. A pair counts the more the nearer
    the two are, and the more opaque they are at both instants. Gradients flow to `means`.
    """
    near, opacity = jax.lax.stop_gradient((means[0], opacities[0] * opacities[1]))
    # Axis by axis, because sums along an axis of length 3 are slow on a CPU.
    squares = sum(jnp.square(axis[:, None] - axis[None]) for axis in near.T)
    no_neighbour = jnp.eye(len(near), dtype=bool) | (opacity == 0)[None]
    nearest, others = jax.lax.top_k(-jnp.where(no_neighbour, jnp.inf, squares), min(NEIGHBOURS, len(near) - 1))
    weights = jnp.sqrt(opacity[:, None] * opacity[others]) * jnp.exp(nearest / RADIUS**2)
    distances = jnp.sqrt(jnp.square(means[:, :, None] - means[:, others]).sum(-1) + SOFTNESS**2)
    return (weights * jnp.abs(distances[1] - distances[0])).sum() / (weights.sum() + PSEUDO_COUNT)
