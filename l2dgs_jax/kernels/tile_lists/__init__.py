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
    """For each pair of a Gaussian and a tile that it reaches, the tile and the index of the Gaussian; no gradients.

    Args:
        box: for each Gaussian, first column and row of the tiles around it, and number of columns and of rows; all
            views one after the other, with the same number of Gaussians in each.
        ellipse: mean (2, pixels), conic (3), and the largest d^T conic d at which the Gaussian is visible.
        tiling: sizes fixed at compilation.

    Returns:
        Tiles, numbered view by view and row by row, and indices of Gaussians, `tiling.capacity` each. The pairs of a
        tile are in the order of the indices. Unused places hold the number of tiles. Pairs that do not fit are dropped.
    """
    if not len(box):
        nowhere = tiling.views * tiling.columns * tiling.rows
        return jnp.full(tiling.capacity, nowhere, jnp.int32), jnp.zeros(tiling.capacity, jnp.int32)
    box, ellipse = jax.lax.stop_gradient((box, ellipse))
    # A loop of one step would be unrolled, but native calls need loops.
    cpu_form = cpu if len(box) > 1 else accelerator
    forms = functions_by_form("list_pairs", reference=reference, cpu=cpu_form, accelerator=accelerator, tiling=tiling)
    pairs = jax.ShapeDtypeStruct((tiling.capacity,), jnp.int32)
    return by_form(box, ellipse, **forms, like=(pairs, pairs))
