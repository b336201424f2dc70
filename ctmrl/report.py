"""`python -m ctmrl.report RUNS`: finished runs as a table over seeds, and as pictures.

Needs neither torch nor an environment: the runs' folders are enough.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.table import Table

from ctmrl.errors import UsageError
from ctmrl.summary import (
    Result,
    collate,
    find_records,
    interquartile_mean,
    interval,
    titled,
    to_csv,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Console

LABELS = {
    "oracle": "oracle (exact optimum)",
    "best_behavior": "best behaviour policy",
    "wind_blind": "wind-blind controller",
    "still": "standing still",
    "random": "random",
}
TITLES = {
    "unseen": "unseen tasks",
    "seen": "seen tasks",
    "fresh": "fresh tasks",
}
COLORS = {"unseen": "#c1440e", "seen": "#1f6f8b", "fresh": "#6a4c93"}


def ordered_groups(record: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The record's groups of tasks in the order they are shown in."""
    return {name: record["groups"][name] for name in TITLES if name in record["groups"]}


def score(value: float, references: dict[str, float]) -> float | None:
    """Normalised score of a mean return: 0 is random, 100 the optimum or the best policy known.

    Returns:
        None where neither is known, or where it is not above random.
    """
    from meta_envs import normalized_score

    expert = references.get("oracle", references.get("best_behavior"))
    if expert is None or expert <= references["random"]:
        return None
    return float(normalized_score(value, references["random"], expert))


def result_table(record: dict[str, Any]) -> Table:
    """Returns and normalised scores of the method beside the references of the same tasks."""
    groups = ordered_groups(record)
    table = Table(
        title=f"{record['env']}, {record['method']}, seed {record['seed']}, last checkpoint"
    )
    table.add_column("")
    for name, group in groups.items():
        count = len(group["tasks"])
        table.add_column(f"{TITLES[name]} ({count})\nreturn", justify="right")
        table.add_column("\nscore", justify="right")
    own = titled(record["method"], record.get("note", ""))
    rows = {own: [g["return"] for g in groups.values()]}
    for key, label in LABELS.items():
        values = [group["references"].get(key) for group in groups.values()]
        if any(value is not None for value in values):
            rows[label] = values
    for index, (label, values) in enumerate(rows.items()):
        cells: list[str] = []
        for value, group in zip(values, groups.values(), strict=True):
            normal = None if value is None else score(value, group["references"])
            cells += ["-" if value is None else f"{value:.2f}"]
            cells += ["-" if normal is None else f"{normal:.1f}"]
        table.add_row(label, *cells, style="bold" if index == 0 else "")
    return table


def write_pictures(record: dict[str, Any], folder: Path) -> None:
    """Write adaptation.png, gone where there was no exploration, and contexts.png into a folder."""
    from datagen.dataset import write_whole

    pictures = {"adaptation.png": adaptation_figure, "contexts.png": context_figure}
    if all(len(group["curve"]) == 1 for group in record["groups"].values()):
        del pictures["adaptation.png"]
        (folder / "adaptation.png").unlink(missing_ok=True)
    for name, draw in pictures.items():
        buffer = BytesIO()
        # Without a version in it, so that equal results give equal bytes.
        draw(record).savefig(buffer, format="png", dpi=110, metadata={"Software": None})
        write_whole(folder / name, buffer.getvalue())


def adaptation_figure(record: dict[str, Any]) -> Figure:
    """Return against episodes of adaptation, with the references as lines."""
    from matplotlib.figure import Figure

    groups = ordered_groups(record)
    figure = Figure(figsize=(5.4 * len(groups), 4.2), layout="constrained")
    # Each with limits of its own: the references of the groups lie far apart.
    all_axes = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, (name, group) in zip(all_axes, groups.items(), strict=True):
        _draw_curve(axes, name, group, record)
    all_axes[0].set_ylabel("return of a fresh episode")
    figure.suptitle(f"{record['env']}: adapting with {record['method']}, seed {record['seed']}")
    return figure


def _draw_curve(axes: Axes, name: str, group: dict[str, Any], record: dict[str, Any]) -> None:
    from matplotlib.ticker import MaxNLocator

    # No spread over tasks: winds and goals make some tasks cheaper for every policy.
    mean = np.array(group["curve"]).mean(axis=1)
    color = COLORS[name]
    axes.plot(
        np.arange(len(mean)), mean, color=color, lw=2, marker="o", ms=4, label=record["method"]
    )
    styles = {"oracle": "-", "best_behavior": "-.", "wind_blind": "--", "still": ":"}
    for key, style in styles.items():
        if key in group["references"]:
            value = group["references"][key]
            axes.axhline(value, color="0.35", ls=style, lw=1, label=f"{LABELS[key]} {value:.2f}")
    for first, said in (
        ("random_episodes", "random actions"),
        ("code_episodes", "acting on codes"),
    ):
        change = record["protocol"].get(first, 0)
        if 0 < change < len(mean) - 1:
            axes.axvspan(0, change, color="0.93", lw=0, zorder=0, label=said)
    near = [value for key, value in group["references"].items() if key != "random"]
    # The first points, on an empty context, may lie far below: cut them off rather than the rest.
    top, bottom = max([*near, mean.max()]), min([*near, mean[1:].min(initial=mean[-1])])
    axes.set_ylim(bottom - 0.6 * (top - bottom), top + 0.1 * (top - bottom))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("episodes of adaptation")
    axes.set_title(f"{TITLES[name]}: {group['return']:.2f}")
    axes.legend(fontsize=8, loc="lower right", framealpha=0.9)


def context_figure(record: dict[str, Any]) -> Figure:
    """Contexts in the plane of their two main directions, coloured by task and by code."""
    from matplotlib.figure import Figure

    groups = ordered_groups(record)
    contexts = np.concatenate([np.array(group["contexts"]) for group in groups.values()])
    params = np.concatenate([np.array(group["params"]) for group in groups.values()])
    points, share = plane(contexts)
    starts = np.cumsum([0, *(len(group["tasks"]) for group in groups.values())])
    parts = [slice(a, b) for a, b in pairwise(starts)]
    has_codes = all(group["codes"] is not None for group in groups.values())
    figure = Figure(figsize=(11 if has_codes else 5.6, 4.8), layout="constrained")
    all_axes = figure.subplots(1, 2 if has_codes else 1, squeeze=False)[0]
    value, title = _parameter(record["param_names"], params)
    # Angles that go round are coloured round: the whole turn, whatever part of it is there.
    turn = title.endswith("degrees") and np.ptp(value) > 200
    limits = (-180.0, 180.0) if turn else _limits(value)
    panels = [(value, "twilight" if turn else "viridis", limits, title)]
    if has_codes:
        codes = np.concatenate([np.array(group["codes"]) for group in groups.values()])
        panels.append((codes, "tab20", _limits(codes), f"code ({len(np.unique(codes))} in use)"))
    for axes, (values, colors, (low, high), label) in zip(all_axes, panels, strict=True):
        for name, part in zip(groups, parts, strict=True):
            drawn = axes.scatter(
                points[part, 0],
                points[part, 1],
                c=values[part],
                cmap=colors,
                vmin=low,
                vmax=high,
                marker="o" if name == "seen" else "*",
                s=45 if name == "seen" else 150,
                edgecolors="0.2",
                linewidths=0.6,
                label=TITLES[name],
            )
        axes.set_xlabel(f"first direction ({share[0]:.0%} of the variance)")
        axes.set_ylabel(f"second direction ({share[1]:.0%})")
        axes.set_title(f"coloured by {label}")
        axes.legend(fontsize=8)
        if colors != "tab20":
            figure.colorbar(drawn, ax=axes, label=label)
    figure.suptitle(f"{record['env']}: contexts after adaptation, {record['method']}")
    return figure


def _limits(values: NDArray[Any]) -> tuple[float, float]:
    """Ends of a colour bar, apart also where all values are one."""
    return float(values.min()), float(max(values.max(), values.min() + 1))


def _parameter(names: list[str], params: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """A number that tells tasks apart, [n], of their parameters [n, P], and its name."""
    if len(names) == 1:
        return params[:, 0], names[0]
    if len(names) == 2:
        angle = np.degrees(np.arctan2(params[:, 1], params[:, 0]))
        return angle, f"angle of ({', '.join(names)}), degrees"
    points, share = plane(params)
    return points[:, 0], f"main direction of {len(names)} parameters ({share[0]:.0%})"


def plane(contexts: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Principal components: contexts [n, Z] -> points [n, 2] and their shares of the variance."""
    # A single context, or contexts of a single number, have a plane too: the rest of it is 0.
    missing = [(0, max(2 - size, 0)) for size in contexts.shape]
    centred = np.pad(contexts - contexts.mean(axis=0), missing)
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    # A direction's sign is arbitrary: let its largest entry be positive.
    largest = np.abs(directions).argmax(axis=1)
    directions = directions * np.sign(directions[np.arange(len(directions)), largest])[:, None]
    share = sizes**2 / max(float((sizes**2).sum()), 1e-12)
    return (centred @ directions[:2].T)[: len(contexts)], share[:2]


@dataclass(frozen=True)
class ReportConfig:
    """Put the results of several seeds together: mean, 95% interval, inter-quartile mean."""

    runs: Annotated[list[Path], tyro.conf.Positional]
    """Run folders, or folders of run folders."""
    csv: Path | None = None
    """Also write one line a seed into this file."""


def summary_table(env: str, group: str, results: list[Result]) -> Table:
    """Returns over seeds of the methods on one group of tasks, beside the references."""
    table = Table(title=f"{env}, {TITLES[group]}")
    table.add_column("")
    for column in ("return", "95% interval", "IQM", "score", "seeds"):
        table.add_column(column, justify="right")
    for result in results:
        low, high = interval(result.returns)
        table.add_row(
            result.title,
            f"{result.returns.mean():.3f}",
            f"{low:.3f} to {high:.3f}" if len(result.seeds) > 1 else "-",
            f"{interquartile_mean(result.returns):.3f}",
            "-" if np.isnan(result.scores).any() else f"{result.scores.mean():.1f}",
            " ".join(map(str, result.seeds)),
            style="" if result.note else "bold",
        )
    references = results[0].references
    for key, label in LABELS.items():
        if key in references:
            normal = score(references[key], references)
            table.add_row(
                label, f"{references[key]:.3f}", "", "", "-" if normal is None else f"{normal:.1f}"
            )
    return table


def print_report(records: list[dict[str, Any]], console: Console) -> list[Result]:
    """Print runs' records as tables over their seeds, and give what the tables are made of."""
    results = collate(records)
    for env, group in dict.fromkeys((result.env, result.group) for result in results):
        rows = [result for result in results if (result.env, result.group) == (env, group)]
        console.print(summary_table(env, group, rows))
        for result in rows:
            values = ", ".join(f"{value:.3f}" for value in result.returns)
            console.print(f"{result.method}, seed by seed: {values}", soft_wrap=True)
    return results


def main(config: ReportConfig) -> None:
    """Read the runs and print."""
    from rich.console import Console

    if config.csv is not None and config.csv.is_dir():
        raise UsageError(f"--csv {config.csv} is a folder: give the name of a file")
    results = print_report(find_records(config.runs), Console())
    if config.csv is not None:
        _write_csv(config.csv, to_csv(results))


def _write_csv(path: Path, text: str) -> None:
    from datagen.dataset import write_whole

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except OSError as error:
        raise UsageError(
            f"--csv {path} cannot be written ({error.strerror}): choose another file"
        ) from None


if __name__ == "__main__":
    from ctmrl.console import run_command

    parse = partial(tyro.cli, ReportConfig, prog="python -m ctmrl.report")
    sys.exit(run_command(lambda: main(parse()), stopped="Stopped."))
