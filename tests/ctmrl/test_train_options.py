"""The command line of `python -m ctmrl.train`: options, defaults, and one sentence a mistake."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from torch import Tensor

from ctmrl import train as command
from ctmrl.config import RunConfig
from ctmrl.console import run_command
from ctmrl.errors import OutOfMemory
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.methods.ctmrl import CTMRLConfig
from ctmrl.methods.focal import FOCALConfig
from ctmrl.presets import preset
from ctmrl.runs import RunFolder, load_checkpoint, read_json
from ctmrl.train import parse
from datagen.dataset import task_file
from meta_envs import ENVIRONMENTS
from tests.ctmrl.commands import Commands, contents
from tests.ctmrl.conftest import FinishedRun
from tests.ctmrl.examples import smoke
from tests.datagen.examples import write_dataset


def test_the_module_itself_is_the_command(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "ctmrl.train", "--method", "ctmlr"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        f"error: no method 'ctmlr'; did you mean 'ctmrl'? (known: {', '.join(METHODS)})\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_misspelt_logger(commands: Commands, wind_path: Path, tmp_path: Path) -> None:
    words = ("ctmrl.train", "--data", str(wind_path), "--out", str(tmp_path / "run"))
    assert commands.run(*words, "--loggers", "tensorbord") == 2
    assert commands.output() == (
        "error: no logger 'tensorbord'; did you mean 'tensorboard'? "
        "(known: tensorboard, trackio, wandb)\n"
    )
    assert not (tmp_path / "run").exists()


@pytest.fixture
def mistake(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    wind_path: Path,
    tmp_path: Path,
) -> Any:
    """Runs the command with a mistake in it; returns the one sentence it ends with."""

    def run_it(*words: str, data: Path = wind_path) -> str:
        monkeypatch.chdir(tmp_path)
        arguments = ["--preset", "smoke", "--data", str(data), "--out", "out", *words]
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        assert run_command(command.main) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        return captured.err.removeprefix("error: ").strip()

    return run_it


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("--env", "point-robt"),
            "no environment 'point-robt'; did you mean 'point_robot'? "
            f"(known: {', '.join(ENVIRONMENTS)})",
        ),
        (("--method", "pearl"), f"no method 'pearl' (known: {', '.join(METHODS)})"),
        (("--preset", "huge"), "no preset 'huge' (known: standard, paper, smoke)"),
        (
            ("--codes", "7"),
            "--codes must be at least 1 and less than the 7 training tasks, got 7",
        ),
        (
            ("--context-episodes", "4"),
            "contexts need 2 x 4 different episodes a task, the dataset has 6: "
            "collect more or lower --context-episodes",
        ),
        (
            ("--device", "gpu"),
            "--device gpu cannot be used here: learning is on cpu or cuda",
        ),
        (("--steps", "0"), "--steps must be at least 1, got 0"),
        (("--tau", "nan"), "--tau must be at least 1e-09, got nan"),
        (("--divergence-target", "nan"), "--divergence-target must be a finite number, got nan"),
        (("--memory", "-1"), "--memory must be at least 0, got -1.0"),
        (("--threads", "100000"), "--threads must be from 1 to 1024, got 100000"),
        (("--seed", "-1"), "--seed must be from 0 to 9.22337e+18, got -1"),
    ],
)
def test_mistakes_are_one_sentence_and_leave_nothing(
    words: tuple[str, ...], said: str, mistake: Any, tmp_path: Path
) -> None:
    assert mistake(*words) == said
    assert not (tmp_path / "out").exists()


TOO_LARGE = (
    "this takes more memory than there is: lower --batch-size, --meta-batch, --context-size, "
    "--repetitions or the widths of the networks (--hidden and others)"
)


@pytest.mark.parametrize("size", ["100000000000", "1000000000000000000"])
@pytest.mark.parametrize("option", ["--batch-size", "--context-size", "--encoder-hidden"])
def test_sizes_beyond_memory_are_one_sentence_and_leave_no_run(
    option: str, size: str, mistake: Any, tmp_path: Path
) -> None:
    assert mistake(option, size) == TOO_LARGE
    # The corrected command may have the folder.
    assert not list(tmp_path.glob("out/*"))


def test_a_run_that_outgrows_memory_later_keeps_its_checkpoint(
    wind_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(learner: Learner) -> dict[str, Tensor]:
        if learner.step == 20:
            raise MemoryError
        return whole(learner)

    whole = Learner.update
    monkeypatch.setattr(Learner, "update", refused)
    config = smoke(40, data=wind_path, out=tmp_path, beside="never")
    with pytest.raises(OutOfMemory, match=f"^{re.escape(TOO_LARGE)}$"):
        command.train(config, Console(file=io.StringIO()))
    assert 0 < load_checkpoint(tmp_path / "checkpoint.pt")["step"] <= 20
    monkeypatch.undo()
    command.train(config, Console(file=io.StringIO()))


def test_wrong_data_is_one_sentence(
    mistake: Any, wind_path: Path, sparse_path: Path, tmp_path: Path
) -> None:
    assert mistake(data=tmp_path / "none").startswith(f"{tmp_path / 'none'}: no dataset is there; ")
    assert mistake(data=sparse_path) == (
        f"{sparse_path} is of sparse_point_robot, not of point_robot_wind: "
        "give --env sparse_point_robot or another --data"
    )
    said = mistake("--quality", "medium")
    assert said.startswith(f"{wind_path / task_file(0)}: has no medium checkpoint: none is 0.2 to ")
    assert said.endswith(
        f"; `python -m datagen.inspect {wind_path}` shows what the slices hold, choose another"
    )
    assert mistake("--data-episodes", "4").startswith(
        f"{wind_path / task_file(0)}: has 3 episodes of checkpoint 200, not the 4 asked for; "
    )
    assert mistake("--quality", "early", "--data-episodes", "1") == (
        "contexts need 2 x 1 different episodes a task, the slice has 1: "
        "ask for more or lower --context-episodes"
    )
    damaged = shutil.copytree(wind_path, tmp_path / "damaged")
    (damaged / task_file(4)).write_bytes(b"x")
    assert "task_004.h5" in mistake(data=damaged)
    single = write_dataset(tmp_path / "single", tasks=(0, 2, 7))
    assert mistake(data=single).startswith(
        f"{single} has 1 training tasks, at least 2 are needed: "
    )
    pair = write_dataset(tmp_path / "pair", tasks=(0, 1))
    assert mistake("--validate", "--codes", "1", data=pair) == (
        f"--validate needs at least 3 training tasks, {pair} has 2: collect more"
    )
    assert not (tmp_path / "out").exists()


def test_an_environment_without_a_dataset_says_how_to_collect_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train", "--env", "HalfCheetahVel-v0"])
    assert run_command(command.main) == 2
    assert capsys.readouterr().err == (
        "error: datasets/half_cheetah_vel: no dataset is there; run `python -m datagen.collect "
        "--env half_cheetah_vel --out datasets/half_cheetah_vel`, or give another folder\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_is_left_alone(mistake: Any, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    for words in ((), ("--restart",)):
        assert mistake(*words) == "out holds files that are not of a run: choose another --out"


def test_a_folder_is_refused_before_the_data_are_read(
    mistake: Any, finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ctmrl.data.OfflineData", None)
    path = shutil.copytree(finished_run.path, tmp_path / "out")
    said = "out holds a run with settings.training.steps = 40, this one has 60: "
    assert mistake().startswith(said)
    folder = RunFolder(path, read_json(path / "config.json"), restart=False)
    assert mistake("--steps", "40") == "another process is at work in out: wait for it"
    folder.close()
    (path / "thesis.tex").write_text("x")
    assert mistake("--restart").startswith("out also holds thesis.tex, which is not of a run: ")
    # A finished run is shown without them too.
    (path / "thesis.tex").unlink()
    words = (*finished_run.words[1:], "--out", str(path))
    monkeypatch.setattr(sys, "argv", ["train", *words])
    assert run_command(command.main) == 0


@pytest.mark.parametrize("rows", [None, 0, 20])
def test_metrics_that_lack_the_checkpoints_row_are_one_sentence(
    rows: int | None, finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    path = shutil.copytree(finished_run.path, tmp_path / "copy")
    (path / "evaluation.json").unlink()
    whole = (path / "metrics.csv").read_bytes()
    (path / "metrics.csv").unlink()
    if rows is not None:
        (path / "metrics.csv").write_bytes(b"".join(whole.splitlines(keepends=True)[:rows]))
    assert commands.run(*finished_run.words, "--out", str(path)) == 2
    assert commands.output().splitlines()[-1] == (
        f"error: {path / 'metrics.csv'} has no row of step 40, which checkpoint.pt is of: "
        "put it back, or train again with --restart"
    )
    # As it says.
    (path / "metrics.csv").write_bytes(whole)
    assert commands.run(*finished_run.words, "--out", str(path)) == 0, commands.output()
    assert contents(path) == contents(finished_run.path)


@pytest.mark.parametrize("content", ["{}", '{"groups": [1]}'])
def test_a_damaged_evaluation_is_one_sentence(
    content: str, finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    path = shutil.copytree(finished_run.path, tmp_path / "copy")
    (path / "evaluation.json").write_text(content)
    assert commands.run(*finished_run.words, "--out", str(path)) == 2
    said = commands.output().splitlines()[-1]
    assert said.startswith(f"error: {path / 'evaluation.json'} does not fit its run (")
    assert said.endswith("): delete it and give the same command again")
    assert "Traceback" not in commands.output()


@pytest.mark.parametrize(
    "words",
    [
        ("--no-such-option", "3"),
        ("--steps", "many"),
        ("--codes",),
        ("stray",),
        ("--quality", "good"),
        ("--precision", "float16"),
    ],
    ids=str,
)
def test_what_is_no_option_is_told_and_exits_with_2(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        parse(["--preset", "smoke", *words])
    assert caught.value.code == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err + captured.out
    assert words[0].strip("-") in captured.err


def test_an_option_of_another_method_is_no_option() -> None:
    assert isinstance(parse(["--codes", "3"]).context, CTMRLConfig)
    with pytest.raises(SystemExit):
        parse(["--method", "focal", "--codes", "3"])


def test_help_shows_the_options_of_the_method(capsys: pytest.CaptureFixture[str]) -> None:
    texts = {}
    for method in ("ctmrl", "focal"):
        with pytest.raises(SystemExit) as caught:
            parse(["--method", method, "--help"])
        assert caught.value.code == 0
        texts[method] = capsys.readouterr().out
    for option in ("--env", "--steps", "--restart", "--validate", "--metric-weight"):
        assert all(option in text for text in texts.values())
    for option in ("--codes", "--no-kmeans", "--no-code-contrast"):
        assert option in texts["ctmrl"]
        assert option not in texts["focal"]


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ([], preset("point_robot_wind", "ctmrl", "standard")),
        (["--env", "PointRobot-v0"], preset("point_robot", "ctmrl", "standard")),
        (["--env=point-robot-wind"], preset("point_robot_wind", "ctmrl", "standard")),
        (["--env", "sparse-point-robot", "--method", "focal", "--preset", "paper"],
         preset("sparse_point_robot", "focal", "paper")),
        (["--preset", "smoke", "--seed", "7"],
         preset("point_robot_wind", "ctmrl", "smoke", seed=7)),
        (["--quality", "expert", "--data-episodes", "10"],
         preset("point_robot_wind", "ctmrl", "standard", quality="expert", data_episodes=10)),
        (["--precision", "bfloat16"],
         preset("point_robot_wind", "ctmrl", "standard", precision="bfloat16")),
        (["--env", "ant-goal"], preset("ant_goal", "ctmrl", "standard", precision="auto")),
        (["--env", "ant-goal", "--precision", "float32"],
         preset("ant_goal", "ctmrl", "standard", precision="float32")),
        (["--device", "cuda:1"],
         preset("point_robot_wind", "ctmrl", "standard", device="cuda:1")),
        (["--memory", "1.5"], preset("point_robot_wind", "ctmrl", "standard", memory=1.5)),
        (["--seed", "7", "--data", "d", "--out", "o", "--restart", "--validate"],
         preset("point_robot_wind", "ctmrl", "standard", seed=7, data=Path("d"), out=Path("o"),
                restart=True, validate=True)),
    ],
    ids=str,
)  # fmt: skip
def test_the_command_line(words: list[str], wanted: RunConfig) -> None:
    assert parse(words) == wanted


def test_the_ablations_and_other_switches_of_the_command_line() -> None:
    ablations = "--no-code-contrast --no-cross-prediction --no-kmeans --no-contrast"
    sizes = "--codes 3 --encoder-hidden 5 7 --hidden 11 --no-decay"
    brac = (
        "--behavior-regularization --dual-penalty gradient --dual-steps 2 --timeouts-as-terminals"
    )
    config = parse(f"{ablations} {sizes} {brac}".split())
    context = config.context
    assert isinstance(context, CTMRLConfig)
    switches = (context.code_contrast, context.cross_prediction, context.kmeans, context.contrast)
    assert switches == (False,) * 4
    assert (context.codes, context.encoder_hidden) == (3, (5, 7))
    assert config.actor_critic.hidden == (11,)
    assert config.actor_critic.behavior_regularization
    assert config.actor_critic.dual_penalty == "gradient"
    assert config.actor_critic.dual_steps == 2
    assert config.actor_critic.timeouts_as_terminals
    assert not config.training.decay
    default = parse(["--method", "focal", "--metric-weight", "3"]).context
    assert isinstance(default, FOCALConfig)
    assert default.metric_weight == 3.0
