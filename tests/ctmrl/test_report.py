"""Tables and pictures of evaluations."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from rich.table import Table
from sklearn.decomposition import PCA

from ctmrl.console import run_command
from ctmrl.report import (
    ReportConfig,
    adaptation_figure,
    context_figure,
    main,
    ordered_groups,
    plane,
    result_table,
    score,
    summary_table,
    write_pictures,
)
from ctmrl.summary import collate
from tests.ctmrl.examples import Z, record


def cells(table: Table) -> dict[str, list[str]]:
    """A table's rows by their first cell."""
    columns = [list(column.cells) for column in table.columns]
    return {str(first): [str(cell) for cell in rest] for first, *rest in zip(*columns, strict=True)}


def printed(table: Table) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_score() -> None:
    references = {"random": -30.0, "oracle": -5.0, "best_behavior": -10.0}
    assert score(-30.0, references) == 0.0
    assert score(-5.0, references) == 100.0
    assert score(-12.5, references) == 70.0
    assert score(-40.0, references) == -40.0
    # Where the optimum is not known, the best behaviour policy is the expert.
    assert score(-20.0, {"random": -30.0, "best_behavior": -10.0}) == 50.0
    assert score(-20.0, {"random": -30.0}) is None
    # A dataset's best policies may be no better than random ones.
    assert score(-20.0, {"random": -30.0, "best_behavior": -30.0}) is None
    assert score(-20.0, {"random": -30.0, "best_behavior": -40.0}) is None


def test_groups_are_shown_unseen_first() -> None:
    assert list(ordered_groups(record())) == ["unseen", "seen"]
    assert list(ordered_groups(record(groups=("fresh",)))) == ["fresh"]


def test_the_result_table() -> None:
    table = result_table(record(seed=2))
    # The record's first group, `seen`, has -10, the second -11.
    assert cells(table) == {
        "ctmrl": ["-11.00", "76.0", "-10.00", "80.0"],
        "oracle (exact optimum)": ["-5.00", "100.0", "-5.00", "100.0"],
        "best behaviour policy": ["-5.50", "98.0", "-5.50", "98.0"],
        "wind-blind controller": ["-6.00", "96.0", "-6.00", "96.0"],
        "random": ["-30.00", "0.0", "-30.00", "0.0"],
    }
    text = printed(table)
    assert "point_robot_wind, ctmrl, seed 2, last checkpoint" in text
    assert text.index("unseen tasks (5)") < text.index("seen tasks (5)", text.index("unseen") + 9)


def test_a_reference_that_a_group_lacks() -> None:
    shown = record()
    del shown["groups"]["unseen"]["references"]["best_behavior"]
    assert cells(result_table(shown))["best behaviour policy"] == ["-", "-", "-5.50", "98.0"]
    del shown["groups"]["seen"]["references"]["best_behavior"]
    assert "best behaviour policy" not in cells(result_table(shown))


def test_the_plane_is_that_of_the_principal_components() -> None:
    contexts = np.random.default_rng(0).normal(size=(17, Z)) * np.arange(1, Z + 1)
    points, share = plane(contexts)
    pca = PCA(n_components=2).fit(contexts)
    wanted = pca.transform(contexts)
    for axis in range(2):
        sign = np.sign(points[:, axis] @ wanted[:, axis])
        np.testing.assert_allclose(points[:, axis], sign * wanted[:, axis], atol=1e-9)
    np.testing.assert_allclose(share, pca.explained_variance_ratio_, rtol=1e-9)


def test_the_planes_sign_does_not_depend_on_the_order_of_the_contexts() -> None:
    contexts = np.random.default_rng(0).normal(size=(17, Z))
    order = np.random.default_rng(1).permutation(17)
    np.testing.assert_allclose(plane(contexts[order])[0], plane(contexts)[0][order], atol=1e-9)


@pytest.mark.parametrize("shape", [(1, Z), (17, 1), (1, 1), (2, Z), (17, 2)])
def test_few_contexts_and_few_numbers_have_a_plane(shape: tuple[int, int]) -> None:
    contexts = np.random.default_rng(0).normal(size=shape)
    points, share = plane(contexts)
    assert points.shape == (shape[0], 2)
    assert share.shape == (2,)
    # Distances in the plane are those between the contexts.
    whole = np.linalg.norm(contexts[:, None] - contexts, axis=2)
    np.testing.assert_allclose(np.linalg.norm(points[:, None] - points, axis=2), whole, atol=1e-9)


def test_equal_contexts_have_a_plane() -> None:
    points, share = plane(np.ones((5, Z)))
    assert not points.any()
    assert not share.any()


def texts(axes: Any) -> str:
    legend = axes.get_legend()
    labels = [text.get_text() for text in legend.get_texts()] if legend else []
    return "\n".join([axes.get_title(), axes.get_xlabel(), axes.get_ylabel(), *labels])


def test_the_adaptation_figure() -> None:
    shown = record()
    # Groups whose returns lie apart must not share their limits.
    apart = shown["groups"]["seen"]
    apart["curve"] = (np.array(apart["curve"]) + 40.0).tolist()
    apart["references"] = {key: value + 40.0 for key, value in apart["references"].items()}
    figure = adaptation_figure(shown)
    unseen, seen = figure.axes
    for axes, name in ((unseen, "unseen"), (seen, "seen")):
        group = shown["groups"][name]
        assert f"{name} tasks: {group['return']:.2f}" in texts(axes)
        wind_blind, oracle = (group["references"][key] for key in ("wind_blind", "oracle"))
        assert f"wind-blind controller {wind_blind:.2f}" in texts(axes)
        assert f"oracle (exact optimum) {oracle:.2f}" in texts(axes)
        curve = np.array(group["curve"]).mean(axis=1)
        lines = [np.asarray(line.get_ydata()) for line in axes.get_lines()]
        assert any(line.shape == curve.shape and np.allclose(line, curve) for line in lines)
        low, high = axes.get_ylim()
        assert low < min(curve[1:].min(), wind_blind)
        assert oracle < high < oracle + 20.0
        assert low > wind_blind - 20.0


@pytest.mark.parametrize(
    ("first", "label"),
    [("random_episodes", "random actions"), ("code_episodes", "acting on codes")],
)
def test_the_adaptation_figure_says_what_came_first(first: str, label: str) -> None:
    shown = record()
    shown["protocol"] |= {"random_episodes": 0, first: 2}
    for axes in adaptation_figure(shown).axes:
        said = texts(axes)
        assert [one for one in ("random actions", "acting on codes") if one in said] == [label]


@pytest.mark.parametrize(("points", "drawn"), [(3, True), (1, False)])
def test_exploration_of_any_kind_is_drawn(points: int, drawn: bool, tmp_path: Path) -> None:
    shown = record()
    shown["protocol"] |= {"random_episodes": 0, "policy_episodes": 0, "code_episodes": points - 1}
    for group in shown["groups"].values():
        group["curve"] = group["curve"][:points]
    write_pictures(shown, tmp_path)
    assert (tmp_path / "adaptation.png").exists() is drawn


@pytest.mark.parametrize(("method", "panels"), [("ctmrl", 2), ("focal", 1)])
def test_the_context_figure_with_and_without_codes(method: str, panels: int) -> None:
    shown = record(method)
    figure = context_figure(shown)
    drawn = [axes for axes in figure.axes if "coloured by" in axes.get_title()]
    assert len(drawn) == panels
    points, _ = plane(np.concatenate([shown["groups"][g]["contexts"] for g in ("unseen", "seen")]))
    for axes in drawn:
        found = np.concatenate([np.asarray(part.get_offsets()) for part in axes.collections])
        np.testing.assert_allclose(found, points)
    if method == "ctmrl":
        codes = {code for group in shown["groups"].values() for code in group["codes"]}
        assert drawn[1].get_title() == f"coloured by code ({len(codes)} in use)"


def test_tasks_of_many_parameters_are_coloured_by_their_main_direction() -> None:
    shown = record(groups=("fresh",))
    group, generator = shown["groups"]["fresh"], np.random.default_rng(0)
    line = np.linspace(-1.0, 1.0, len(group["tasks"]))
    noise = generator.normal(scale=0.01, size=(len(line), 41))
    shown["param_names"] = [f"a_rather_long_name_{index}" for index in range(41)]
    group["params"] = (line[:, None] * np.linspace(0.1, 1.0, 41) + noise).tolist()
    drawn = context_figure(shown).axes[0]
    assert drawn.get_title() == "coloured by main direction of 41 parameters (100%)"
    colors = np.asarray(drawn.collections[0].get_array())
    assert np.corrcoef(colors, line)[0, 1] > 0.99


@pytest.mark.parametrize(("ends", "turn"), [((-134.0, 84.0), True), ((0.0, 180.0), False)])
def test_angles_that_go_round_have_the_colours_of_a_whole_turn(
    ends: tuple[float, float], turn: bool
) -> None:
    shown = record(groups=("fresh",))
    group = shown["groups"]["fresh"]
    angles = np.radians(np.linspace(*ends, len(group["tasks"])))
    group["params"] = np.stack([np.cos(angles), np.sin(angles)], axis=1).tolist()
    (drawn,) = context_figure(shown).axes[0].collections
    assert drawn.get_clim() == pytest.approx((-180.0, 180.0) if turn else ends)
    assert drawn.get_cmap().name == ("twilight" if turn else "viridis")


@pytest.mark.parametrize("change", ["fresh", "one parameter", "one task", "no adaptation"])
def test_records_of_other_shapes_are_drawn(change: str) -> None:
    shown = record(groups=("fresh",))
    group = shown["groups"]["fresh"]
    if change == "one parameter":
        shown["param_names"] = ["velocity"]
        group["params"] = [row[:1] for row in group["params"]]
    elif change == "one task":
        for key in ("tasks", "params", "contexts", "codes"):
            group[key] = group[key][:1]
        group["curve"] = [row[:1] for row in group["curve"]]
    elif change == "no adaptation":
        shown["protocol"] |= {"random_episodes": 0, "policy_episodes": 0}
        group["curve"] = group["curve"][:1]
    assert len(adaptation_figure(shown).axes) == 1
    assert len(context_figure(shown).axes) == 3


def test_equal_records_give_equal_pictures(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        write_pictures(record(groups=("fresh",)), tmp_path / name)
    for picture in ("adaptation.png", "contexts.png"):
        first, second = ((tmp_path / name / picture).read_bytes() for name in ("first", "second"))
        assert first == second
        with Image.open(tmp_path / "first" / picture) as image:
            assert min(image.size) > 300
            assert "Software" not in image.info
            assert len(np.unique(np.asarray(image.convert("L")))) > 30


def write_records(folder: Path) -> None:
    for method in ("ctmrl", "focal"):
        for seed in (0, 1, 3):
            path = folder / method / f"seed-{seed}" / "evaluation.json"
            path.parent.mkdir(parents=True)
            path.write_text(json.dumps(record(method, seed)))


def test_the_summary_table() -> None:
    results = collate([{**record(seed=seed), "run": f"seed-{seed}"} for seed in (0, 1, 3)])
    (unseen,) = [result for result in results if result.group == "unseen"]
    rows = cells(summary_table("point_robot_wind", "unseen", [unseen]))
    value, bounds, iqm, normal, seeds = rows["ctmrl"]
    assert (value, normal, seeds) == ("-10.333", "78.7", "0 1 3")
    low, high = map(float, bounds.split(" to "))
    assert -12.0 <= low < -10.4 < -10.3 < high <= -9.0
    assert iqm == "-10.333"
    assert rows["oracle (exact optimum)"][0] == "-5.000"
    single = collate([{**record(), "run": "seed-0"}])[:1]
    assert cells(summary_table("point_robot_wind", "seen", single))["ctmrl"][1] == "-"


def test_what_has_no_score_and_what_stands_still() -> None:
    run = {**record(), "run": "runs/a"}
    for group in run["groups"].values():
        group["references"] = {"random": -30.0, "still": -20.0}
        group["score"] = None
    rows = cells(summary_table("half_cheetah_vel", "seen", collate([run])[:1]))
    assert rows["ctmrl"][3] == "-"
    assert rows["standing still"][:4] == ["-20.000", "", "", "-"]
    assert cells(result_table(run))["standing still"] == ["-20.00", "-", "-20.00", "-"]


def test_a_reference_is_called_one_in_every_table() -> None:
    made = record("oracle_task") | {"note": "reference, given the true task"}
    title = "oracle_task (reference, given the true task)"
    results = collate([{**made, "run": "seed-0"}, {**record(), "run": "seed-1"}])
    rows = [result for result in results if result.group == "unseen"]
    for table in (result_table(made), summary_table("point_robot_wind", "unseen", rows)):
        assert title in cells(table)
        assert "oracle_task" not in cells(table)
    assert "ctmrl" in cells(summary_table("point_robot_wind", "unseen", rows))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_records(tmp_path / "runs")
    table = tmp_path / "new" / "table.csv"
    assert run_command(lambda: main(ReportConfig([tmp_path / "runs"], table))) == 0
    output = capsys.readouterr().out
    assert "point_robot_wind, unseen tasks" in output
    assert "focal, seed by seed: -9.000, -10.000, -12.000" in output
    lines = table.read_text().splitlines()
    assert lines[0] == "env,method,group,seed,return,score"
    assert "point_robot_wind,ctmrl,unseen,3,-12.0000,72.00" in lines
    assert len(lines) == 1 + 2 * 2 * 3


def test_a_folder_without_runs_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(lambda: main(ReportConfig([tmp_path]))) == 2
    assert capsys.readouterr().err == (
        f"error: no finished run in {tmp_path}: name folders that python -m ctmrl.train made\n"
    )


def test_a_csv_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_records(tmp_path / "runs")
    (tmp_path / "file").write_text("")
    assert run_command(lambda: main(ReportConfig([tmp_path / "runs"], tmp_path))) == 2
    captured = capsys.readouterr()
    assert captured.err == f"error: --csv {tmp_path} is a folder: give the name of a file\n"
    assert captured.out == ""
    below = tmp_path / "file" / "table.csv"
    assert run_command(lambda: main(ReportConfig([tmp_path / "runs"], below))) == 2
    assert capsys.readouterr().err == (
        f"error: --csv {below} cannot be written (File exists): choose another file\n"
    )


def test_a_report_needs_no_torch() -> None:
    code = "import sys, ctmrl.report; print({'torch', 'matplotlib', 'gymnasium'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
