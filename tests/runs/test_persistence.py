"""A training in a run folder that is killed, stopped, or runs out of disk, memory or finite numbers.

Its steps are replaced by counting ones: the tests are about everything around them.
"""

import builtins
import errno
import io
import json
import os
import signal

import jax
import jax.numpy as jnp
import pytest
from tiny_training import assert_equal_states, make_dataset, report, tiny

from l2dgs_jax import runs
from l2dgs_jax.config import DensityConfig
from l2dgs_jax.errors import DISK_FULL, DIVERGED, OUT_OF_MEMORY, Interrupted, UserError
from l2dgs_jax.runs import checkpoints, folder, persistence, recorder
from l2dgs_jax.runs.divergence import standing
from l2dgs_jax.training import engine, initial_state

CONFIG = tiny(checkpoint_every=3, density=DensityConfig(start=1, stop=0))
STEPS = CONFIG.steps


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def counting_step(states, batches, values, number, *, config, **_):
    """A step that shows which steps were taken before it, and at which rates."""
    gaussians = states.scene.params.gaussians
    rate = states.adam.schedules["means"].start[:, None, None]
    params = states.scene.params._replace(gaussians=gaussians._replace(means=0.5 * gaussians.means + rate * number))
    after = states._replace(scene=states.scene._replace(params=params), step=states.step + 1)
    return after, report(), engine.Tally(jnp.int32(0), jnp.int32(1))


def use_counting_steps(monkeypatch, dataset):
    first = initial_state(dataset, CONFIG)
    monkeypatch.setattr(folder, "initial_state", lambda *_: first)
    monkeypatch.setattr(recorder, "LOG_EVERY", 2)
    monkeypatch.setattr(engine, "train_steps", counting_step)


@pytest.fixture(autouse=True)
def quick(dataset, monkeypatch):
    use_counting_steps(monkeypatch, dataset)


class Watcher:
    """A display that records its events; it can ask for a stop after a step."""

    def __init__(self, stop_after=None):
        self.events, self.reached, self.stop_after = [], 0, stop_after

    def __call__(self, event, **facts):
        self.events.append((event, facts))
        if event == "step":
            self.reached = facts["step"]

    def stopping(self):
        return signal.SIGTERM if self.reached == self.stop_after else None


def train_to_end(run_folder, dataset, watcher=None, config=CONFIG):
    """Train in a folder, from its last checkpoint to the end."""
    watcher = watcher or Watcher()
    start = standing(run_folder, dataset, config)
    return persistence.fit_in_folder(run_folder, dataset, config, start, watcher, watcher.stopping, 1)


def metrics(run_folder):
    lines = [json.loads(line) for line in (run_folder / runs.METRICS).read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in ("seconds", "memory")} for line in lines]


class KilledError(BaseException):
    """The process has been killed: nothing after this reaches the disk."""


class Killer:
    """Intercepts operations on files, and kills the process in the middle of operation number `at`."""

    def __init__(self, monkeypatch, at=None):
        self.at, self.dead, self.operations = at, False, []
        for name in ("replace", "fsync", "unlink"):
            monkeypatch.setattr(os, name, self.guarded(name, getattr(os, name)))
        for module in (builtins, io):
            monkeypatch.setattr(module, "open", self.opening(io.open))

    def guarded(self, name, act):
        def guarded(file, *arguments, **options):
            where = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else str(file)
            return None if self.ends(name, where) else act(file, *arguments, **options)

        return guarded

    def ends(self, name, where):
        if len(self.operations) == self.at and not self.dead:
            self.dead = True
            raise KilledError
        self.operations.append((name, os.path.basename(where)))
        return self.dead

    def opening(self, real):
        def open_file(file, mode="r", *arguments, **options):
            if mode[0] not in "wa":
                return real(file, mode, *arguments, **options)
            raw = KillableFile(str(file), mode, self)
            buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            return buffered if "b" in mode else io.TextIOWrapper(buffered)

        return open_file


class KillableFile(io.FileIO):
    """A file in which a killed process leaves half of what it was writing."""

    def __init__(self, path, mode, killer):
        super().__init__(path, mode.replace("b", ""))
        self.killer = killer

    def write(self, data):
        try:
            return len(data) if self.killer.ends("write", self.name) else super().write(data)
        except KilledError:
            super().write(bytes(data)[: len(data) // 2])
            raise


@pytest.fixture(scope="module")
def uninterrupted(dataset, tmp_path_factory):
    """An uninterrupted training: its folder, its last state, and the operations on files that it took."""
    run_folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        use_counting_steps(patch, dataset)
        killer = Killer(patch)
        run = train_to_end(run_folder, dataset)
    return run_folder, run.state, killer.operations


def kill_and_resume(dataset, uninterrupted, run_folder, at):
    expected, last_state, _ = uninterrupted
    run_folder.mkdir()
    watcher = Watcher()
    with pytest.MonkeyPatch.context() as patch:
        Killer(patch, at)
        with pytest.raises(KilledError):
            train_to_end(run_folder, dataset, watcher)
    lost = watcher.reached - int(standing(run_folder, dataset, CONFIG).state.step)
    assert -1 <= lost <= CONFIG.checkpoint_every  # -1: on the disk before the watcher was told
    assert_equal_states(train_to_end(run_folder, dataset).state, last_state)
    assert metrics(run_folder) == metrics(expected)
    assert sorted(file.name for file in run_folder.iterdir()) == sorted(file.name for file in expected.iterdir())


def test_a_training_killed_in_every_kind_of_file_operation_resumes(dataset, uninterrupted, tmp_path):
    operations = uninterrupted[2]
    kinds = set(operations)
    for kind in (
        ("write", "checkpoint.tmp.npz"),
        ("fsync", "checkpoint.tmp.npz"),
        ("replace", "checkpoint.npz"),
        ("replace", "checkpoint.tmp.npz"),
        ("write", "metrics.jsonl"),
    ):
        assert kind in kinds
        last = max(number for number, operation in enumerate(operations) if operation == kind)
        kill_and_resume(dataset, uninterrupted, tmp_path / str(last), last)


@pytest.mark.slow
def test_a_training_killed_in_any_file_operation_resumes(dataset, uninterrupted, tmp_path):
    operations = uninterrupted[2]
    writes = [number for number, (name, file) in enumerate(operations) if name == "write" and "npz" in file]
    moments = sorted(set(range(len(operations))) - set(writes) | set(writes[:: len(writes) // 12]))
    assert len(moments) >= 30
    for moment in moments:
        kill_and_resume(dataset, uninterrupted, tmp_path / str(moment), moment)


@pytest.mark.parametrize("step", [1, 3, 4, STEPS])
def test_a_training_stopped_by_a_signal_resumes_to_the_same_result(dataset, uninterrupted, tmp_path, step):
    with pytest.raises(Interrupted, match=f"stopped after step {step} of {STEPS}") as caught:
        train_to_end(tmp_path, dataset, Watcher(stop_after=step))
    assert caught.value.code == 128 + signal.SIGTERM
    assert standing(tmp_path, dataset, CONFIG).state.step == step
    assert_equal_states(train_to_end(tmp_path, dataset).state, uninterrupted[1])
    assert metrics(tmp_path) == metrics(uninterrupted[0])


def test_a_torn_line_of_metrics_is_dropped(dataset, uninterrupted, tmp_path):
    with pytest.raises(Interrupted):
        train_to_end(tmp_path, dataset, Watcher(stop_after=4))
    with open(tmp_path / runs.METRICS, "a") as file:
        file.write('{"step": 5, "sta')
    assert [line["step"] for line in runs.read_metrics(tmp_path)] == [2, 4]
    train_to_end(tmp_path, dataset)
    assert metrics(tmp_path) == metrics(uninterrupted[0])


def test_metrics_of_steps_without_a_valid_pixel_are_json(dataset, tmp_path, monkeypatch):
    def step(*arguments, **options):
        states, found, tally = counting_step(*arguments, **options)
        return states, found._replace(psnr=jnp.full_like(found.psnr, jnp.inf)), tally

    monkeypatch.setattr(engine, "train_steps", step)
    with pytest.raises(Interrupted):
        train_to_end(tmp_path, dataset, Watcher(stop_after=4))
    train_to_end(tmp_path, dataset)
    written = (tmp_path / runs.METRICS).read_text()
    for line in written.splitlines():
        assert json.loads(line, parse_constant=pytest.fail)["psnr"] == "Infinity"
    assert {line["psnr"] for line in runs.read_metrics(tmp_path)} == {float("inf")}


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_full_disk_is_reported_in_one_sentence_and_loses_nothing(dataset, uninterrupted, tmp_path, monkeypatch, name):
    with pytest.raises(Interrupted):
        train_to_end(tmp_path, dataset, Watcher(stop_after=4))

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, name, full)
        with pytest.raises(UserError, match=r"cannot be written \(No space left") as caught:
            train_to_end(tmp_path, dataset)
    assert caught.value.code == DISK_FULL
    assert not list(tmp_path.glob("*.tmp*"))
    assert standing(tmp_path, dataset, CONFIG).state.step == 4
    assert_equal_states(train_to_end(tmp_path, dataset).state, uninterrupted[1])


def test_out_of_memory_is_reported_in_one_sentence(dataset, tmp_path, monkeypatch):
    def exhausted(states, batches, values, number, **rest):
        if number == 4:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")
        return counting_step(states, batches, values, number, **rest)

    monkeypatch.setattr(engine, "train_steps", exhausted)
    with pytest.raises(UserError, match=f"out of memory after step 4 of {STEPS}; expected .*--downscale") as caught:
        train_to_end(tmp_path, dataset)
    assert caught.value.code == OUT_OF_MEMORY


def diverging(at, below):
    """Steps of which number `at` diverges unless rates are at most `below` times the initial ones."""

    def train_steps(states, batches, values, number, **rest):
        if number == at and states.adam.schedules["means"].start[0] >= below * CONFIG.optim.means_lr * 1.01:
            return states, report(), engine.Tally(jnp.int32(0), jnp.int32(0))
        return counting_step(states, batches, values, number, **rest)

    return train_steps


def rollbacks(watcher):
    return [(facts["step"], facts["rate_factor"]) for event, facts in watcher.events if event == "diverged"]


def test_a_diverging_training_is_rolled_back_and_continues_at_lower_rates(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "train_steps", diverging(at=7, below=0.25))
    (tmp_path / "whole").mkdir()
    watcher = Watcher()
    expected = train_to_end(tmp_path / "whole", dataset, watcher).state
    # The second time it goes back one checkpoint further.
    assert rollbacks(watcher) == [(6, 0.5), (3, 0.25)]
    assert [line["rate_factor"] for line in metrics(tmp_path / "whole")] == [1.0, 0.25, 0.25, 0.25]
    assert standing(tmp_path / "whole", dataset, CONFIG).halvings == 2
    rate = expected.adam.schedules["means"].start
    assert rate == 0.25 * initial_state(dataset, CONFIG).adam.schedules["means"].start

    for step in (5, 7):  # killed after the rollbacks, and before them
        run_folder = tmp_path / f"stopped-{step}"
        run_folder.mkdir()
        with pytest.raises(KilledError):
            train_to_end(run_folder, dataset, killed_after(step, after_rollback=step == 5))
        assert_equal_states(train_to_end(run_folder, dataset).state, expected)
        assert metrics(run_folder) == metrics(tmp_path / "whole")


def killed_after(step, after_rollback):
    watcher = Watcher()

    def show(event, **facts):
        watcher(event, **facts)
        if event == "step" and facts["step"] == step and (rollbacks(watcher) or not after_rollback):
            raise KilledError

    show.stopping = watcher.stopping
    return show


def test_a_training_that_lower_rates_do_not_help_is_given_up(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "train_steps", diverging(at=1, below=0.0))
    watcher = Watcher()
    with pytest.raises(UserError, match=r"not finite at step 1 .*; expected a loss that falls") as caught:
        train_to_end(tmp_path, dataset, watcher)
    assert caught.value.code == DIVERGED
    assert rollbacks(watcher) == [(0, 0.5), (0, 0.25), (0, 0.125)]
    assert not checkpoints.kept(tmp_path / runs.CHECKPOINT)


LONG = tiny(fine_steps=20, checkpoint_every=3, density=DensityConfig(start=1, stop=0))


def exploding(losses, below):
    """Steps with given losses; tenfold from step 14, unless rates are at most `below` times the initial ones."""

    def train_steps(states, batches, values, number, **rest):
        fast = states.adam.schedules["means"].start[0] >= below * LONG.optim.means_lr * 1.01
        after, _, tally = counting_step(states, batches, values, number, **rest)
        return after, report(losses[number] * (10 if fast and number >= 13 else 1)), tally

    return train_steps


@pytest.mark.parametrize(("below", "returns"), [(0.5, [(12, 0.5)]), (0.25, [(12, 0.5), (12, 0.25)])])
def test_a_training_whose_loss_explodes_is_rolled_back(dataset, tmp_path, monkeypatch, below, returns):
    monkeypatch.setattr(recorder, "LOG_EVERY", 1)
    losses = [1 / (1 + 0.1 * step) for step in range(LONG.steps)]
    monkeypatch.setattr(engine, "train_steps", exploding(losses, below))
    watcher = Watcher()
    train_to_end(tmp_path, dataset, watcher, LONG)
    assert rollbacks(watcher) == returns
    assert "by step 16 the loss has grown 8-fold" in next(f["message"] for e, f in watcher.events if "message" in f)
    assert metrics(tmp_path)[-1]["step"] == LONG.steps


def test_a_training_whose_loss_explodes_at_any_rate_is_given_up(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "LOG_EVERY", 1)
    monkeypatch.setattr(engine, "train_steps", exploding([1.0] * LONG.steps, below=0.0))
    with pytest.raises(UserError, match=r"by step 1\d the loss has grown 10-fold; expected a loss") as caught:
        train_to_end(tmp_path, dataset, config=LONG)
    assert caught.value.code == DIVERGED
