"""Training (Eqs. 10-15): objective, optimizer, densification, and the loop; nothing here reads or writes files."""

from l2dgs_jax.training.engine import DivergedError, Member, Progress
from l2dgs_jax.training.initial_state import initial_state, resolve, state_shapes
from l2dgs_jax.training.state import Batch, StepReport, TrainState

__all__ = [
    "Batch",
    "DivergedError",
    "Member",
    "Progress",
    "StepReport",
    "TrainState",
    "initial_state",
    "resolve",
    "state_shapes",
]
