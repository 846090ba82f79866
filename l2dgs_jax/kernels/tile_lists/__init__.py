"""Which Gaussians touch which tile, as a list of pairs."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.selection import by_form, functions_by_form
from l2dgs_jax.kernels.tile_lists import accelerator, cpu, reference
from l2dgs_jax.kernels.tiles import Tiling


def list_pairs(
    box: Int[Array, "G 4"], ellipse: Float[Array, "G 6"], tiling: Tiling
) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
    """For each pair of a Gaussian and a tile that it reaches, the tile and the row of the Gaussian; no gradients.

    Args:
        box: first column and row of tiles around each Gaussian, and numbers of columns and rows, those of all views
            one after the other, as many in each.
        ellipse: mean (2, pixels), conic (3), and the d^T conic d up to which it is seen.
        tiling: sizes fixed at compilation.

    Returns:
        `capacity` tiles, numbered view by view and row by row, and rows; the pairs of a tile come in the order of the
        rows. Places without a pair have the tile after the last. What does not fit is dropped.
    """
    if not len(box):
        nowhere = tiling.views * tiling.columns * tiling.rows
        return jnp.full(tiling.capacity, nowhere, jnp.int32), jnp.zeros(tiling.capacity, jnp.int32)
    box, ellipse = jax.lax.stop_gradient((box, ellipse))
    # A loop of one step would be unrolled, and native calls want loops.
    cpu_form = cpu if len(box) > 1 else accelerator
    forms = functions_by_form("list_pairs", reference=reference, cpu=cpu_form, accelerator=accelerator, tiling=tiling)
    pairs = jax.ShapeDtypeStruct((tiling.capacity,), jnp.int32)
    return by_form(box, ellipse, **forms, like=(pairs, pairs))
