"""`python -m datagen.exchange`: what it says, and loaders of other packages on our files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from datagen.dataset import open_dataset
from datagen.exchange import main
from tests.datagen.environments import other_environment, run
from tests.datagen.examples import task_data, write_dataset
from tests.datagen.legacy import write_legacy

Capture = pytest.CaptureFixture[str]
STARTER = Path(__file__).parents[2] / "datasets" / "point_robot_wind"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "data", (0, 2, 3))


def test_to_d4rl(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "out"
    assert main(["to-d4rl", str(folder), "--out", str(out), "--tasks", "0,3"]) == 0
    with h5py.File(out / "point_robot_wind.hdf5") as file:
        assert np.unique(file["task"][...]).tolist() == [0, 3]
    assert "point_robot_wind.hdf5: 2 tasks, 0.0 MB." in capsys.readouterr().out


def test_from_legacy(tmp_path: Path, capsys: Capture) -> None:
    write_legacy(tmp_path / "legacy", task_data(3))
    out = tmp_path / "out"
    arguments = ["from-legacy", str(tmp_path / "legacy"), "--env", "PointRobotWind-v0"]
    assert main([*arguments, "--out", str(out)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said == [
        f"{out}: 1 tasks, 100 transitions.",
        "Deterministic returns are unknown; they repeat the stochastic ones.",
        f"check it: python -m datagen.check {out}",
    ]
    assert open_dataset(out).tasks.tolist() == [3]


def test_mistakes_are_one_sentence(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    none, out = str(tmp_path / "none"), str(tmp_path / "out")
    mistakes = {
        ("to-minari", str(folder)): "needs the package minari",
        ("to-minari", none): "no dataset is there",
        ("to-d4rl", none, "--out", out): "no dataset is there",
        ("to-d4rl", str(folder), "--out", out, "--tasks", "1"): "has no task 1",
        ("to-d4rl", str(folder), "--out", out, "--tasks", "x"): "--tasks takes numbers",
        ("from-legacy", none, "--env", "ant_goal", "--out", out): "is no folder",
        ("from-legacy", none, "--env", "ant", "--out", out): "no environment 'ant'",
        ("from-legacy", str(folder), "--env", "ant_goal", "--out", out): "no folder goal_idx0",
    }
    for arguments, sentence in mistakes.items():
        assert main(arguments) == 2
        said = capsys.readouterr()
        assert sentence in said.err
        assert (said.out, said.err.count("\n")) == ("", 1)
    assert not Path(out).exists()


def test_ctrl_c_is_a_sentence(
    folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("datagen.exchange._Bar.done", interrupted)
    assert main(["to-d4rl", str(folder), "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "interrupted; nothing is left half written\n"
    assert list((tmp_path / "out").iterdir()) == []


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom datagen.exchange import main\ntry:\n main(['to-d4rl', '--help'])\n"
        "finally:\n print(*({'torch', 'stable_baselines3', 'mujoco', 'minari'} & set(sys.modules)),"
        " file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stderr.split() == []
    assert "--out" in done.stdout


HUGGING_FACE = """
import sys
import datasets, h5py, numpy as np

folder, cache = sys.argv[1:]
loaded = datasets.load_dataset(folder, cache_dir=cache)
files = datasets.load_dataset_builder(folder, cache_dir=cache).config.data_files
for split, rows in loaded.items():
    rows = rows.with_format("numpy")[:]
    start = 0
    for path in files[split]:
        with h5py.File(path) as file:
            for name in file:
                values = file[name][...]
                assert np.array_equal(rows[name][start:start + len(values)], values), (path, name)
        start += len(values)
    print(split, start)
one = datasets.load_dataset("hdf5", data_files=f"{folder}/task_003.h5", cache_dir=cache)["train"]
print(one.num_rows, *sorted(one.column_names))
"""


@pytest.mark.slow
def test_hugging_face_opens_the_folder_as_it_is(tmp_path: Path) -> None:
    python = other_environment(tmp_path / "venv", "datasets>=5")
    said = run(
        python, HUGGING_FACE, str(STARTER), str(tmp_path / "cache"),
        HF_HUB_OFFLINE="1", HF_HOME=str(tmp_path / "home"),
    ).splitlines()  # fmt: skip
    dataset = open_dataset(STARTER, verify=False)
    sizes = {
        split: sum(one["transitions"] for one in dataset.index["tasks"] if one["split"] == split)
        for split in ("train", "test")
    }
    data = dataset.read(3)
    assert said == [
        *(f"{split} {rows}" for split, rows in sizes.items()),
        f"{len(data)} {' '.join(sorted(data.columns))}",
    ]


D3RLPY = """
import json, sys
import d3rlpy, h5py, numpy as np

with h5py.File(sys.argv[1]) as file:
    columns = {name: file[name][...] for name in file}
dataset = d3rlpy.dataset.MDPDataset(
    columns["observations"], columns["actions"], columns["rewards"], columns["terminals"],
    columns["timeouts"],
)
for name in ("observations", "actions", "rewards"):
    rows = np.concatenate([getattr(episode, name) for episode in dataset.episodes])
    assert np.array_equal(rows.reshape(columns[name].shape), columns[name]), name
cloning = d3rlpy.algos.BCConfig(batch_size=32).create(device="cpu:0")
logs = d3rlpy.logging.NoopAdapterFactory()
cloning.fit(dataset, n_steps=20, n_steps_per_epoch=20, logger_adapter=logs, show_progress=False)
action = cloning.predict(columns["observations"][:3])
returns = [float(episode.compute_return()) for episode in dataset.episodes]
ends = [bool(episode.terminated) for episode in dataset.episodes]
print("RESULT", json.dumps([returns, ends, list(action.shape)]))
"""


@pytest.mark.slow
def test_d3rlpy_learns_from_a_file_as_it_is(tmp_path: Path) -> None:
    python = other_environment(tmp_path / "venv", "d3rlpy>=2.8")
    said = run(python, D3RLPY, str(STARTER / "task_003.h5"))
    (line,) = (line for line in said.splitlines() if line.startswith("RESULT"))
    returns, ends, shape = json.loads(line.removeprefix("RESULT"))
    data = open_dataset(STARTER, verify=False).read(3)
    wanted = np.bincount(data.episode, weights=data.rewards)
    assert returns == pytest.approx(wanted.tolist(), abs=1e-3)
    assert ends == [False] * len(wanted)
    assert shape == [3, 2]
