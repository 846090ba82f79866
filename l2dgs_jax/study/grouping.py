"""Which members of a study one compiled program can train together."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from l2dgs_jax.config import Config, overrides
from l2dgs_jax.data import load_dataset
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.enhancement import enhanced
from l2dgs_jax.study.spec import Plan, Spec
from l2dgs_jax.training import resolve


@dataclass(frozen=True)
class Trial:
    """A member of a study with its data loaded and its settings resolved by `training.resolve`."""

    plan: Plan
    dataset: Dataset
    config: Config


def load_groups(spec: Spec) -> list[list[Trial]]:
    """Load every scene once, and group the members that one program can train.

    Members of a group have images and planes of the same size, and settings that differ only in the numbers of
    `overrides.TRACED`.

    Raises:
        UserError: a scene cannot be read, or the study requires one program and its members need several.
    """
    datasets: dict[tuple, Dataset] = {}
    groups: dict[tuple, list[Trial]] = {}
    for plan in spec.plans:
        c = plan.config
        key = (plan.scene, *c.reading.values(), c.enhance, c.enhance != "none" and c.seed)
        if key not in datasets:
            datasets[key] = enhanced(load_dataset(plan.scene, **c.reading), c.enhance, int(c.seed))
        dataset = datasets[key]
        trial = Trial(plan, dataset, resolve(c, dataset))
        groups.setdefault((overrides.outline(trial.config), *_shapes(trial).values()), []).append(trial)
    if spec.one_program and len(groups) > 1:
        raise UserError(_difference(list(groups.values())))
    return list(groups.values())


def _shapes(trial: Trial) -> dict[str, object]:
    dataset, model = trial.dataset, trial.config.model
    by_frame = model.tracks or model.exposure == "drifting" or model.decomposition == "curve"
    return {
        "image size": f"{dataset.width}x{dataset.height}",
        "number of training frames": len(dataset.train.names) if by_frame or model.time_size is None else None,
        "having pixels that do not count": dataset.train.valid is not None,
        "having depth": dataset.train.depths is not None,
    }


def _difference(groups: Sequence[Sequence[Trial]]) -> str:
    """Why the first members of the first two groups cannot be trained together."""
    a, b = groups[0][0], groups[1][0]
    shapes = [(name, x, _shapes(b)[name]) for name, x in _shapes(a).items() if x != _shapes(b)[name]]
    settings = overrides.differences([overrides.outline(a.config), overrides.outline(b.config)])
    name, *values = shapes[0] if shapes else next((name, *values) for name, values in settings.items())
    names = f"{a.plan.name} ({Path(a.plan.scene).name}) and {b.plan.name} ({Path(b.plan.scene).name})"
    return (
        f"{names} cannot share one program: {name} is {values[0]} and {values[1]}; expected members that agree in it, "
        "or a study without one_program"
    )
