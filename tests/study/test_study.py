"""Studies: reading their files, grouping their members, and reporting results; nothing is trained here."""

import json

import numpy as np
import pytest
from scenes import write_json, write_nerfies

from l2dgs_jax import runs, sweep
from l2dgs_jax.config import PRESETS, overrides
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line
from l2dgs_jax.study import report, running
from l2dgs_jax.study.grouping import load_groups
from l2dgs_jax.study.spec import read
from l2dgs_jax.training import engine

STUDY = """
scenes = ["a", "b"]
seeds = [0, 3]
preset = "demo"

[settings]
coarse_steps = 5
model.hidden = 16

[grid]
loss.exposure_level = [0.4, 0.5]
model.initial_exponents = [["auto", 9], [2, 8]]

[[variants]]
name = "slow"
optim.heads_lr = 1e-4

[[variants]]
name = "fast"
optim.heads_lr = 1e-3
"""


@pytest.fixture
def study(tmp_path):
    def write(text):
        (tmp_path / "study.toml").write_text(text)
        return tmp_path / "study.toml"

    return write


def test_members_are_all_combinations(study, tmp_path):
    plans = read(study(STUDY)).plans
    assert len(plans) == 2 * 2 * 4 * 2
    assert len({plan.name for plan in plans}) == len(plans)
    assert {plan.scene for plan in plans} == {str(tmp_path / "a"), str(tmp_path / "b")}
    for plan in plans:
        assert (plan.config.coarse_steps, plan.config.model.hidden) == (5, 16)
        assert plan.config.fine_steps == PRESETS["demo"].fine_steps
        assert plan.config.seed == plan.varied["seed"]
        assert plan.config.loss.exposure_level == plan.varied["loss.exposure_level"]
        assert plan.config.optim.heads_lr == plan.varied["optim.heads_lr"]
    assert plans[0].name == "00-a-seed0-exposure_level0.4-initial_exponentsauto_9.0-slow"
    first = [(p.config.seed, p.config.loss.exposure_level, p.config.optim.heads_lr) for p in plans[:3]]
    assert first == [(0, 0.4, 1e-4), (0, 0.4, 1e-3), (0, 0.4, 1e-4)]


def test_a_variant_can_have_a_preset_of_its_own(study):
    variants = '[[variants]]\nname = "a"\n[[variants]]\nname = "b"\npreset = "4dgs"\nloss.ssim = 0.5'
    text = f'scenes = ["demo"]\npreset = "demo"\n{variants}'
    a, b = read(study(text)).plans
    assert (a.variant, a.config, a.varied) == ("a", PRESETS["demo"], {"seed": 0})
    assert (b.variant, b.varied) == ("b", {"seed": 0, "preset": "4dgs", "loss.ssim": 0.5})
    assert b.config == overrides.replace(PRESETS["4dgs"], {"loss.ssim": 0.5})


def test_scenes_alone_are_a_study(study):
    (plan,) = read(study('scenes = ["demo"]')).plans
    assert (plan.scene, plan.config, plan.varied) == ("demo", PRESETS["default"], {"seed": 0})


@pytest.mark.parametrize(
    ("text", "naming"),
    [
        ("scenes = [", "not TOML"),
        ("", "scenes"),
        ("scenes = []", "scenes"),
        ('scenes = "a"', "scenes"),
        ('scenes = ["a", "a"]', "scenes"),
        ('scenes = ["a"]\nseeds = [1.5]', "seeds"),
        ('scenes = ["a"]\nseeds = [-1]', "seeds"),
        ('scenes = ["a"]\nsede = [1]', "sede"),
        ('scenes = ["a"]\npreset = "nice"', "nice"),
        ('scenes = ["a"]\npreset = ["default"]', "no preset is called"),
        ('scenes = ["a"]\none_program = 1', "one_program"),
        ('scenes = ["a"]\nsettings = 3', "settings"),
        ('scenes = ["a"]\n[settings]\nloss.nonsense = 1', "loss.nonsense"),
        ('scenes = ["a"]\n[settings]\nloss.ssim = "much"', "loss.ssim"),
        ('scenes = ["a"]\n[settings]\nseed = 1', "seeds"),
        ('scenes = ["a"]\n[settings]\ncoarse_steps = 0\nfine_steps = 0', "--coarse-steps"),
        ('scenes = ["a"]\n[grid]\nloss.ssim = 1.0', "loss.ssim"),
        ('scenes = ["a"]\n[grid]\nloss.ssim = []', "loss.ssim"),
        ('scenes = ["a"]\n[grid]\nloss.ssim = [1.0, 1]', "different values"),
        ('scenes = ["a", "b/../a"]', "named twice"),
        (
            'scenes = ["a"]\n[grid]\nloss.ssim = [0.5, 1.0]\n[[variants]]\nname = "x"\nloss.ssim = 2.0',
            "'x' sets loss.ssim",
        ),
        ('scenes = ["a"]\n[grid]\nloss.ssim = [1.0, "x"]', "loss.ssim"),
        ('scenes = ["a"]\n[[variants]]\nloss.ssim = 1.0', "name"),
        ('scenes = ["a"]\n[[variants]]\nname = "a/b"', "name"),
        ('scenes = ["a"]\n[[variants]]\nname = "b"\npreset = "nice"', "nice"),
        ('scenes = ["a"]\n[[variants]]\nname = "x"\n[[variants]]\nname = "x"', "name"),
    ],
)
def test_a_malformed_study_is_refused_in_one_sentence(study, text, naming):
    with pytest.raises(UserError, match=r"study\.toml") as caught:
        read(study(text))
    assert naming in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_reported_in_one_sentence(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command_line.run(sweep.main, [str(tmp_path / "nonsuch.toml"), str(tmp_path / "out")])
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert "nonsuch.toml" in message
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for seed, name in enumerate("ab"):
        write_nerfies(folder / name, 8, 24, 18, num_points=20 + 5 * seed, seed=seed)
    write_nerfies(folder / "wide", 8, 30, 18, num_points=20)
    write_nerfies(folder / "long", 12, 24, 18, num_points=20)
    (write_nerfies(folder / "deep", 8, 24, 18, num_points=20) / "depth" / "1x").mkdir(parents=True)
    np.save(folder / "deep" / "depth" / "1x" / "000000.npy", np.ones((18, 24)))
    return folder


def test_members_of_one_shape_are_one_group(scenes):
    (scenes / "study.toml").write_text(
        'scenes = ["a", "wide", "b", "long"]\nseeds = [0, 1]\n[grid]\nloss.ssim = [0.5, 1.0]\nmodel.hidden = [8, 16]'
    )
    groups = load_groups(read(scenes / "study.toml"))
    seen = [{(trial.plan.scene.split("/")[-1], trial.config.model.hidden) for trial in group} for group in groups]
    assert seen == [{(name, h) for name in names} for names in ("ab", ["wide"], ["long"]) for h in (8, 16)]
    assert [len(group) for group in groups] == [8, 8, 4, 4, 4, 4]
    a, b = (next(e.config for e in groups[0] if e.plan.scene.endswith(name)) for name in "ab")
    assert a.model.initial_exponents[0] != "auto" != b.model.initial_exponents[0]


def test_members_that_brighten_their_frames_form_their_own_group(scenes):
    (scenes / "study.toml").write_text('scenes = ["a"]\npreset = "4dgs"\n[grid]\nenhance = ["none", "gamma"]')
    (dark,), (bright,) = load_groups(read(scenes / "study.toml"))
    assert bright.dataset.train.images.mean() > 1.5 * dark.dataset.train.images.mean()
    np.testing.assert_array_equal(bright.dataset.test.images, dark.dataset.test.images)


@pytest.mark.parametrize(
    ("text", "naming"),
    [
        ('scenes = ["a", "wide"]', ["image size is 24x18 and 30x18", "wide"]),
        ('scenes = ["a", "long"]', ["number of training frames is 6 and 9"]),
        ('scenes = ["a", "long"]\npreset = "curve-4dgs"', ["number of training frames is 6 and 9"]),
        ('scenes = ["a", "deep"]', ["having depth is False and True"]),
        ('scenes = ["a"]\n[grid]\nmodel.hidden = [8, 16]', ["model.hidden is 8 and 16"]),
        ('scenes = ["a", "nonsuch"]', ["nonsuch", "no such folder"]),
    ],
)
def test_members_that_cannot_share_a_program_are_refused_in_one_sentence(scenes, text, naming):
    (scenes / "study.toml").write_text(f"one_program = true\n{text}")
    with pytest.raises(UserError) as caught:
        load_groups(read(scenes / "study.toml"))
    for part in (*naming, "expected"):
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def refused(scenes, tmp_path, capsys):
    """A function that runs a sweep and returns the sentence with which it is refused."""
    (scenes / "study.toml").write_text('scenes = ["a"]')

    def run(*arguments):
        with pytest.raises(SystemExit) as caught:
            command_line.run(sweep.main, [str(scenes / "study.toml"), str(tmp_path / "out"), *arguments])
        assert caught.value.code == 2
        message = capsys.readouterr().err
        assert message.startswith("error: ")
        assert message.count("\n") == 1
        return message

    return run


def test_a_folder_with_other_content_is_refused(refused, tmp_path):
    assert "out" in refused("--resume")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").touch()
    assert "already holds" in refused()
    (tmp_path / "out" / running.PLANS_FILE).write_text("[]")
    assert "other members" in refused("--resume")


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        (["--coordinator", "nowhere"], "HOST:PORT"),
        (["--coordinator", "localhost:1"], "--processes"),
        (["--coordinator", "localhost:1", "--processes", "2"], "--process"),
        (["--coordinator", "localhost:1", "--processes", "2", "--process", "2"], "--process 2"),
        (["--coordinator", "localhost:1", "--processes", "2", "--process", "1", "--timeout", "0"], "--timeout"),
        (["--devices", "0"], "--devices"),
    ],
)
def test_invalid_options_are_refused_in_one_sentence(refused, tmp_path, arguments, naming):
    assert naming in refused(*arguments)
    assert not (tmp_path / "out").exists()


def test_the_step_at_which_the_last_member_diverges_is_passed_on(monkeypatch):
    """Even if it is the first: its members must be recorded as diverged."""
    first, last = (engine.Progress(step, None, None, 8) for step in (1, 2))

    def run(*_):
        yield first
        raise engine.DivergedError("not finite", last)

    monkeypatch.setattr(engine, "run", run)
    assert list(running._steps([], None, None)) == [first, last]


def test_the_table_shows_what_was_varied_and_scored(tmp_path):
    scores = {"gaussians": 7, "lowlight": {"psnr": 30.12345, "ssim": 0.9}}
    perfect = {"gaussians": 7, "lowlight": {"psnr": "Infinity", "ssim": 1.0}}
    results = [
        {
            "scene": "/s/a",
            "variant": "",
            "varied": {"seed": 0, "loss.ssim": 0.5},
            "ended": "finished",
            "scores": scores,
        },
        {"scene": "/s/b", "variant": "", "varied": {"seed": 0}, "ended": "diverged at step 3", "scores": perfect},
    ]
    for name, result in zip("xy", results, strict=True):
        (tmp_path / name).mkdir()
        (tmp_path / name / report.RESULT_FILE).write_text(json.dumps(result))
        lines = [json.dumps({"step": step, "psnr": 20 + np.log(step)}) + "\n" for step in (1, 10, 20)]
        (tmp_path / name / runs.METRICS).write_text("".join(lines))
    assert report.write(tmp_path, "xy") == [report.JSON, report.MARKDOWN, report.PLOTS]
    assert json.loads((tmp_path / report.JSON).read_text())["members"][1]["ended"] == "diverged at step 3"
    assert (tmp_path / report.MARKDOWN).read_text().splitlines() == [
        "| scene | seed | loss.ssim | ended | Gaussians | low-light PSNR | low-light SSIM |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| a | 0 | 0.5 | finished | 7 | 30.123 | 0.900 |",
        "| b | 0 |  | diverged at step 3 | 7 | inf | 1.000 |",
    ]
    assert (tmp_path / report.PLOTS).stat().st_size > 1000
    named = [result | {"variant": name, "scene": f"/{name}/a"} for name, result in zip("xy", results, strict=True)]
    assert [line.split(" | ")[:2] for line in report.markdown(named).splitlines()[2:]] == [
        ["| x/a", "x"],
        ["| y/a", "y"],
    ]


def test_low_light_scores_after_gains_of_their_own_are_marked():
    scores = {"gaussians": 7, "lowlight": {"psnr": 30.0, "ssim": 0.9}, "welllit": {"overall": {"psnr": 20.0}}}
    members = [
        {"scene": gain, "variant": "", "varied": {}, "ended": "finished", "scores": scores | {"lowlight_gain": gain}}
        for gain in ("none", "own")
    ]
    assert report.markdown(members).splitlines()[2:] == [
        "| none | finished | 7 | 30.000 | 0.900 | 20.000 |",
        "| own | finished | 7 | 30.000 (own gain) | 0.900 (own gain) | 20.000 |",
    ]


def test_scenes_are_called_by_as_much_of_their_paths_as_tells_them_apart():
    names = report.scene_names(["demo", "/data/toys", "/a/one/left", "/b/one/left", "/a/two/left", "/c/demo"])
    assert list(names.values()) == ["demo", "toys", "a/one/left", "b/one/left", "two/left", "c/demo"]


def test_a_study_that_cannot_start_leaves_no_folder(study, tmp_path):
    spec = read(study('scenes = ["nonsuch"]\n[settings]\ncoarse_steps = 2\nfine_steps = 0'))
    with pytest.raises(UserError, match="nonsuch"):
        running.run_study(spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_study_mentions_what_is_odd_about_its_scenes_once_and_works_alone(study, tmp_path, monkeypatch, capsys):
    scene = write_nerfies(tmp_path / "blobs", truth=True)
    (scene / "mask" / "1x" / "000003.png").unlink()
    settings = "[settings]\nmodel.tracks = false\nmodel.surfaces = false"
    spec = read(study(f'scenes = ["{scene}"]\nseeds = [0, 1]\n{settings}'))

    def train(group, output, mesh):
        with pytest.raises(UserError, match="another process is training in it"):
            running.run_study(spec, output, resume=True)
        raise MemoryError

    monkeypatch.setattr(running, "_train", train)
    with pytest.raises(UserError, match="out of memory in group 1 of 1; expected fewer --devices"):
        running.run_study(spec, tmp_path / "out")
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in printed if line.startswith("note: ")] == [
        "note: mask/1x/ has pictures of 5 of 6 frames, but not of '000003': not used"
    ]
    assert sum(line.startswith("warning: blobs: 6 frames are few") for line in printed) == 1


def test_a_study_that_has_begun_meanwhile_is_not_overwritten(study, tmp_path, monkeypatch):
    spec = read(study('scenes = ["demo"]\npreset = "demo"'))

    def load(spec):
        write_json(tmp_path / "out" / running.PLANS_FILE, ["another"])
        return []

    monkeypatch.setattr(running, "load_groups", load)
    with pytest.raises(UserError, match="out: already holds a study"):
        running.run_study(spec, tmp_path / "out")
    assert json.loads((tmp_path / "out" / running.PLANS_FILE).read_text()) == ["another"]
