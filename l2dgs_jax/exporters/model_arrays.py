"""A whole model, decomposed and moving, as named arrays with everything that is needed to render it."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.errors import UserError
from l2dgs_jax.model.decomposition import full_light
from l2dgs_jax.model.deformation import has_path, length_unit, openness
from l2dgs_jax.rasterizer.projection import NEAR_PLANE
from l2dgs_jax.runs import Run

REQUIRED_SETTINGS = {"decomposition": "retinex", "ocd": True, "unit_exponent": None}  # of the model


def model_arrays(run: Run) -> dict[str, Shaped[np.ndarray, "..."]]:
    """The arrays of an exported .npz by name, floats in single precision; docs/export.md describes each of them.

    Raises:
        UserError: the scene lacks a part of the model that these arrays describe.
    """
    scene, cfg, dataset = run.state.scene, run.config.model, run.dataset
    for name, required in REQUIRED_SETTINGS.items():
        if getattr(cfg, name) != required:
            raise UserError(f"{run.name}: model.{name} is {getattr(cfg, name)}; expected {required} for this format")
    params, alive = scene.params, np.asarray(scene.alive)
    gaussians = {name: rows for name, rows in params.gaussians._asdict().items() if rows is not None}
    if "gate" in gaussians:
        gaussians["gate"] = np.where(openness(gaussians["gate"], cfg) > 0, gaussians["gate"], -np.inf)
    coefficients = [gaussians.pop("illumination_dc"), gaussians.pop("illumination_rest")]
    gaussians["illumination"] = np.concatenate(coefficients, axis=-1)[:, : (run.renderer().sh_degree + 1) ** 2]
    unit = length_unit(scene.extent, cfg)
    gaussians = {name: np.asarray(rows)[alive] for name, rows in gaussians.items()}
    if params.paths is not None and params.gaussians.lifetimes is not None:
        follows = np.asarray(has_path(params.gaussians.lifetimes))[alive]
        paths = np.asarray(params.paths)[np.asarray(scene.path_of)[alive]]
        gaussians["paths"] = np.where(follows[:, None, None], paths, 0)
    tree: dict[str, Any] = {
        "gaussians": gaussians,
        "hexplane": params.hexplane,
        "heads": params.heads,
        "ocd": params.ocd,
        "bafe": params.bafe if cfg.bafe else {"out": {"bias": params.bafe.out.bias}},
        "bounds": scene.bounds,
        "length_unit": unit,
        "near_plane": NEAR_PLANE * unit,
        "moving": run.moving,
        "aggregation": cfg.aggregation,
        "scale_growth": cfg.scale_growth,
        "time_range": cfg.time_range,
        "box_rim": cfg.box_rim,
        "illumination_offset": cfg.illumination_offset,
        "background": cfg.background,
        "domain": cfg.domain,
        "full_light": full_light(cfg),
        "width": dataset.width,
        "height": dataset.height,
        "train": _cameras(dataset.train),
        "test": _cameras(dataset.test),
    }
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): _single(leaf) for path, leaf in leaves}


def _cameras(split: Split) -> dict[str, Any]:
    return {"names": np.array(split.names, str), **split.cameras._asdict()}


def _single(leaf: Any) -> Shaped[np.ndarray, "..."]:
    array = np.asarray(leaf)
    return array.astype(np.float32) if array.dtype.kind == "f" else array
