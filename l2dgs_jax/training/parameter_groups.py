"""Which learning rate every parameter has."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.config import OptimConfig
from l2dgs_jax.training.optimizer import Schedule
from l2dgs_jax.types import Gaussians, SceneParams

GAUSSIAN_GROUPS: dict[str, Any] = {
    "means": "means",
    "quats": "quats",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "illumination_dc": "illumination",
    "illumination_rest": "illumination_rest",
    "reflectance": "reflectance",
    "attenuation": "attenuation",
    "gate": "gate",
    "lifetimes": "lifetimes",
    "color_rest": "illumination_rest",
}


def groups(params: SceneParams) -> SceneParams:
    """The learning-rate group of every leaf of `params`, by name (see `schedules`)."""
    present: dict[str, Any] = params.gaussians._asdict()
    gaussians: dict[str, Any] = {
        name: rows if rows is None else GAUSSIAN_GROUPS[name] for name, rows in present.items()
    }
    label = lambda name, tree: jax.tree.map(lambda _: name, tree)
    return params._replace(
        gaussians=Gaussians(**gaussians),
        hexplane=label("planes", params.hexplane),
        heads=label("heads", params.heads),
        ocd=label("ocd", params.ocd),
        bafe=label("bafe", params.bafe),
        paths=label("paths", params.paths),
        exposures=label("exposures", params.exposures),
        curves=label("curves", params.curves),
    )


def schedules(cfg: OptimConfig, extent: Float[Array, ""], stage_steps: int) -> dict[str, Schedule]:
    """The schedule of every group that `groups` names.

    Args:
        cfg: rates and decay.
        extent: world units, multiplies the rates of `cfg.extent_scales`.
        stage_steps: length of a decay where `cfg.decay_steps` is None.
    """
    rates = {
        "means": (cfg.means_lr, cfg.means_lr_end),
        "heads": (cfg.heads_lr, cfg.heads_lr_end),
        "planes": (cfg.planes_lr, cfg.planes_lr_end),
        "ocd": (cfg.ocd_lr, cfg.ocd_lr_end),
        "bafe": (cfg.bafe_lr, cfg.bafe_lr_end),
        "illumination": (cfg.illumination_lr, cfg.illumination_lr),
        "illumination_rest": (cfg.illumination_lr / cfg.illumination_rest_divisor,) * 2,
        "reflectance": (cfg.reflectance_lr, cfg.reflectance_lr),
        "attenuation": (cfg.attenuation_lr, cfg.attenuation_lr),
        "opacities": (cfg.opacity_lr, cfg.opacity_lr),
        "scales": (cfg.scales_lr, cfg.scales_lr),
        "quats": (cfg.quats_lr, cfg.quats_lr),
        "gate": (cfg.gate_lr, cfg.gate_lr),
        "paths": (cfg.paths_lr, cfg.paths_lr),
        "lifetimes": (cfg.lifetimes_lr, cfg.lifetimes_lr),
        "exposures": (cfg.exposures_lr, cfg.exposures_lr),
        "curves": (cfg.curves_lr, cfg.curves_lr),
    }
    steps = jnp.maximum(stage_steps if cfg.decay_steps is None else cfg.decay_steps, 1)
    factor = lambda name: extent if name in cfg.extent_scales else jnp.ones_like(extent)
    return {
        name: Schedule(start * factor(name), end * factor(name), jnp.full_like(extent, steps))
        for name, (start, end) in rates.items()
    }
