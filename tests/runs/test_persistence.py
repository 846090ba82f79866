"""A training in a run folder that is killed, stopped, or runs out of disk, memory or finite numbers.

Its steps only count: what is tried is all that happens around them.
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


def count(states, batches, values, number, *, config, **_):
    """A step that shows which steps were taken before it, and at which rates."""
    gaussians = states.scene.params.gaussians
    rate = states.adam.schedules["means"].start[:, None, None]
    params = states.scene.params._replace(gaussians=gaussians._replace(means=0.5 * gaussians.means + rate * number))
    after = states._replace(scene=states.scene._replace(params=params), step=states.step + 1)
    return after, report(), engine.Tally(jnp.int32(0), jnp.int32(1))


def only_count(monkeypatch, dataset):
    first = initial_state(dataset, CONFIG)
    monkeypatch.setattr(folder, "initial_state", lambda *_: first)
    monkeypatch.setattr(recorder, "LOG_EVERY", 2)
    monkeypatch.setattr(engine, "train_steps", count)


@pytest.fixture(autouse=True)
def quick(dataset, monkeypatch):
    only_count(monkeypatch, dataset)


class Watcher:
    """A display that keeps what it is told; it can ask for a stop after a step."""

    def __init__(self, stop_after=None):
        self.told, self.reached, self.stop_after = [], 0, stop_after

    def __call__(self, event, **facts):
        self.told.append((event, facts))
        if event == "step":
            self.reached = facts["step"]

    def stopping(self):
        return signal.SIGTERM if self.reached == self.stop_after else None


def go_on(place, dataset, watcher=None, config=CONFIG):
    """Train in a folder from where it stands to the end."""
    watcher = watcher or Watcher()
    start = standing(place, dataset, config)
    return persistence.fit_in_folder(place, dataset, config, start, watcher, watcher.stopping, 1)


def metrics(place):
    lines = [json.loads(line) for line in (place / runs.METRICS).read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in ("seconds", "memory")} for line in lines]


class KilledError(BaseException):
    """The process is gone: nothing after this reaches the disk."""


class Killer:
    """Stands between the package and the disk, and ends the process in the middle of the operation of some number."""

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
            raw = Mortal(str(file), mode, self)
            buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            return buffered if "b" in mode else io.TextIOWrapper(buffered)

        return open_file


class Mortal(io.FileIO):
    """A file that a killed process leaves with half of what it was writing."""

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
def whole(dataset, tmp_path_factory):
    """An uninterrupted training: its folder, its last state, and the operations on files that it took."""
    place = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        only_count(patch, dataset)
        killer = Killer(patch)
        run = go_on(place, dataset)
    return place, run.state, killer.operations


def kill_and_go_on(dataset, whole, place, at):
    expected, last_state, _ = whole
    place.mkdir()
    watcher = Watcher()
    with pytest.MonkeyPatch.context() as patch:
        Killer(patch, at)
        with pytest.raises(KilledError):
            go_on(place, dataset, watcher)
    lost = watcher.reached - int(standing(place, dataset, CONFIG).state.step)
    assert -1 <= lost <= CONFIG.checkpoint_every  # -1: on the disk before it was told
    assert_equal_states(go_on(place, dataset).state, last_state)
    assert metrics(place) == metrics(expected)
    assert sorted(file.name for file in place.iterdir()) == sorted(file.name for file in expected.iterdir())


def test_killed_in_the_middle_of_every_kind_of_operation_on_files(dataset, whole, tmp_path):
    operations = whole[2]
    kinds = set(operations)
    for kind in (
        ("write", "checkpoint.tmp.npz"),
        ("fsync", "checkpoint.tmp.npz"),
        ("replace", "checkpoint.npz"),
        ("replace", "checkpoint.tmp.npz"),
        ("write", "metrics.jsonl"),
    ):
        assert kind in kinds
        last = max(number for number, same in enumerate(operations) if same == kind)
        kill_and_go_on(dataset, whole, tmp_path / str(last), last)


@pytest.mark.slow
def test_killed_in_the_middle_of_any_operation_on_files(dataset, whole, tmp_path):
    operations = whole[2]
    writes = [number for number, (name, file) in enumerate(operations) if name == "write" and "npz" in file]
    moments = sorted(set(range(len(operations))) - set(writes) | set(writes[:: len(writes) // 12]))
    assert len(moments) >= 30
    for moment in moments:
        kill_and_go_on(dataset, whole, tmp_path / str(moment), moment)


@pytest.mark.parametrize("step", [1, 3, 4, STEPS])
def test_stopped_by_a_signal_it_goes_on_to_the_same_result(dataset, whole, tmp_path, step):
    with pytest.raises(Interrupted, match=f"stopped after step {step} of {STEPS}") as caught:
        go_on(tmp_path, dataset, Watcher(stop_after=step))
    assert caught.value.code == 128 + signal.SIGTERM
    assert standing(tmp_path, dataset, CONFIG).state.step == step
    assert_equal_states(go_on(tmp_path, dataset).state, whole[1])
    assert metrics(tmp_path) == metrics(whole[0])


def test_a_torn_line_of_metrics_is_dropped(dataset, whole, tmp_path):
    with pytest.raises(Interrupted):
        go_on(tmp_path, dataset, Watcher(stop_after=4))
    with open(tmp_path / runs.METRICS, "a") as file:
        file.write('{"step": 5, "sta')
    assert [line["step"] for line in runs.read_metrics(tmp_path)] == [2, 4]
    go_on(tmp_path, dataset)
    assert metrics(tmp_path) == metrics(whole[0])


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_full_disk_is_one_sentence_and_loses_nothing(dataset, whole, tmp_path, monkeypatch, name):
    with pytest.raises(Interrupted):
        go_on(tmp_path, dataset, Watcher(stop_after=4))

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, name, full)
        with pytest.raises(UserError, match=r"cannot be written \(No space left") as caught:
            go_on(tmp_path, dataset)
    assert caught.value.code == DISK_FULL
    assert not list(tmp_path.glob("*.tmp*"))
    assert standing(tmp_path, dataset, CONFIG).state.step == 4
    assert_equal_states(go_on(tmp_path, dataset).state, whole[1])


def test_out_of_memory_is_one_sentence(dataset, tmp_path, monkeypatch):
    def exhausted(states, batches, values, number, **rest):
        if number == 4:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")
        return count(states, batches, values, number, **rest)

    monkeypatch.setattr(engine, "train_steps", exhausted)
    with pytest.raises(UserError, match=f"out of memory after step 4 of {STEPS}; expected .*--downscale") as caught:
        go_on(tmp_path, dataset)
    assert caught.value.code == OUT_OF_MEMORY


def diverging(at, below):
    """Steps of which that of number `at` is finite only below that part of the first rates."""

    def take(states, batches, values, number, **rest):
        if number == at and states.adam.schedules["means"].start[0] >= below * CONFIG.optim.means_lr * 1.01:
            return states, report(), engine.Tally(jnp.int32(0), jnp.int32(0))
        return count(states, batches, values, number, **rest)

    return take


def put_back(watcher):
    return [(facts["step"], facts["rate_factor"]) for event, facts in watcher.told if event == "diverged"]


def test_a_diverging_training_goes_back_and_on_at_lower_rates(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "train_steps", diverging(at=7, below=0.25))
    (tmp_path / "whole").mkdir()
    watcher = Watcher()
    expected = go_on(tmp_path / "whole", dataset, watcher).state
    # The second time it goes back beyond the checkpoint that has not helped.
    assert put_back(watcher) == [(6, 0.5), (3, 0.25)]
    assert [line["rate_factor"] for line in metrics(tmp_path / "whole")] == [1.0, 0.25, 0.25, 0.25]
    assert standing(tmp_path / "whole", dataset, CONFIG).halvings == 2
    rate = expected.adam.schedules["means"].start
    assert rate == 0.25 * initial_state(dataset, CONFIG).adam.schedules["means"].start

    for step in (5, 7):  # before and after it was put back, as `reached` counts
        place = tmp_path / f"stopped-{step}"
        place.mkdir()
        with pytest.raises(KilledError):
            go_on(place, dataset, dying_after(step, put_back_first=step == 5))
        assert_equal_states(go_on(place, dataset).state, expected)
        assert metrics(place) == metrics(tmp_path / "whole")


def dying_after(step, put_back_first):
    watcher = Watcher()

    def show(event, **facts):
        watcher(event, **facts)
        if event == "step" and facts["step"] == step and (put_back(watcher) or not put_back_first):
            raise KilledError

    show.stopping = watcher.stopping
    return show


def test_a_training_that_lower_rates_do_not_help_is_given_up(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "train_steps", diverging(at=1, below=0.0))
    watcher = Watcher()
    with pytest.raises(UserError, match=r"not finite at step 1 .*; expected a loss that falls") as caught:
        go_on(tmp_path, dataset, watcher)
    assert caught.value.code == DIVERGED
    assert put_back(watcher) == [(0, 0.5), (0, 0.25), (0, 0.125)]
    assert not checkpoints.kept(tmp_path / runs.CHECKPOINT)


LONG = tiny(fine_steps=20, checkpoint_every=3, density=DensityConfig(start=1, stop=0))


def exploding(losses, below):
    """Steps of those losses, ten times as large from step 14 on unless rates are below that part of the first."""

    def take(states, batches, values, number, **rest):
        fast = states.adam.schedules["means"].start[0] >= below * LONG.optim.means_lr * 1.01
        after, _, tally = count(states, batches, values, number, **rest)
        return after, report(losses[number] * (10 if fast and number >= 13 else 1)), tally

    return take


@pytest.mark.parametrize(("below", "returns"), [(0.5, [(12, 0.5)]), (0.25, [(12, 0.5), (12, 0.25)])])
def test_a_loss_that_explodes_is_put_back_before_it(dataset, tmp_path, monkeypatch, below, returns):
    monkeypatch.setattr(recorder, "LOG_EVERY", 1)
    losses = [1 / (1 + 0.1 * step) for step in range(LONG.steps)]
    monkeypatch.setattr(engine, "train_steps", exploding(losses, below))
    watcher = Watcher()
    go_on(tmp_path, dataset, watcher, LONG)
    assert put_back(watcher) == returns
    assert "by step 16 the loss has grown 8-fold" in next(f["message"] for e, f in watcher.told if "message" in f)
    assert metrics(tmp_path)[-1]["step"] == LONG.steps


def test_a_loss_that_explodes_at_any_rate_is_given_up(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "LOG_EVERY", 1)
    monkeypatch.setattr(engine, "train_steps", exploding([1.0] * LONG.steps, below=0.0))
    with pytest.raises(UserError, match=r"by step 1\d the loss has grown 10-fold; expected a loss") as caught:
        go_on(tmp_path, dataset, config=LONG)
    assert caught.value.code == DIVERGED
