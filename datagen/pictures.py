"""Pictures of a dataset. Matplotlib is used through its objects: no window, no global state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import StrMethodFormatter
from numpy.typing import NDArray

from datagen.dataset import Dataset, TaskData
from datagen.rollout import episode_returns
from meta_envs.registry import definition

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN_TRAIN, SHOWN_TEST = 4, 2
"""Train and test tasks whose episodes are drawn."""
EPISODES_A_CHECKPOINT = 2
"""Episodes of each checkpoint that are drawn of a task."""
TRAIN, TEST = "#1f5fa8", "#c8601a"


def draw(dataset: Dataset, path: Path) -> None:
    """Write a picture: returns by checkpoint on the left, episodes on the right.

    Where observations are points of the plane the episodes of a few tasks are drawn as paths,
    elsewhere as a histogram of all their returns.

    Args:
        dataset: any.
        path: a .png or a .pdf file.

    Raises:
        DatasetError: a task's file is damaged.
        OSError: the picture could not be written.
    """
    figure = Figure(figsize=(13.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.0, 1.35)))
    figure.suptitle(
        f"{dataset.index['env_id']}, {len(dataset.tasks)} tasks, budget {dataset.index['budget']}"
    )
    _draw_returns(left.subplots(), dataset.index["tasks"])
    if _in_the_plane(dataset.env):
        _draw_paths(right, [dataset.read(task) for task in _shown_tasks(dataset)])
    else:
        _draw_histogram(right.subplots(), [dataset.read(int(task)) for task in dataset.tasks])
    # No date and no version, so that the same dataset gives the same picture.
    figure.savefig(path, dpi=130, metadata=_without_date(path))


def _in_the_plane(env: str) -> bool:
    return definition(env).observation_space.shape == (2,)


def _without_date(path: Path) -> dict[str, None]:
    return {"CreationDate": None} if path.suffix.lower() == ".pdf" else {"Software": None}


def _shown_tasks(dataset: Dataset) -> list[int]:
    """A few train tasks and fewer test tasks, of each kind some at equal distances."""
    shown: set[int] = set()
    for tasks, most in ((dataset.train_tasks, SHOWN_TRAIN), (dataset.test_tasks, SHOWN_TEST)):
        rows = np.linspace(0, len(tasks) - 1, min(most, len(tasks))).round().astype(int)
        shown.update(tasks[rows].tolist())
    return sorted(shown)


def _draw_returns(axes: Axes, records: Sequence[Mapping[str, Any]]) -> None:
    marks = sorted(records[0]["returns"]["behavior"], key=int)
    x = [int(mark) for mark in marks]
    for split, colour in (("train", TRAIN), ("test", TEST)):
        group = [one["returns"] for one in records if one["split"] == split]
        if not group:
            continue
        values = np.array([[one["behavior"][mark] for mark in marks] for one in group])
        low, high = np.quantile(values, [0.1, 0.9], axis=0)
        axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        label = f"{len(group)} {split} tasks, mean and 10-90 %"
        axes.plot(x, values.mean(axis=0), "o-", color=colour, markersize=4, label=label)
        for name, style in (("expert", "--"), ("random", ":")):
            level = float(np.mean([one[name] for one in group]))
            label = f"{name} on {split} tasks, {level:.2f}"
            axes.axhline(level, color=colour, linestyle=style, label=label)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_xlabel("checkpoint: training steps of the behaviour policy")
    axes.set_ylabel("return of its stochastic episodes")
    axes.grid(alpha=0.25)
    axes.legend(loc="center right", frameon=False)
    axes.set_title("Behaviour policies")


def _draw_paths(figure: SubFigure, tasks: Sequence[TaskData]) -> None:
    """Small pictures of a few tasks' episodes, coloured by return on one scale."""
    returns = [episode_returns(data.columns) for data in tasks]
    scale = Normalize(*np.quantile(np.concatenate(returns), [0.05, 1.0]))
    columns = min(2, len(tasks))
    grid = figure.subplots(
        -(-len(tasks) // columns), columns, sharex=True, sharey=True, squeeze=False
    )
    for axes in grid.flat[len(tasks) :]:
        axes.set_axis_off()
    for axes, data, values in zip(grid.flat, tasks, returns, strict=False):
        paths = [_path(data, episode) for episode in _shown_episodes(data)]
        lines = LineCollection(paths, cmap="viridis", norm=scale, linewidths=1.0, alpha=0.8)
        lines.set_array(values[_shown_episodes(data)])
        axes.add_collection(lines)
        starts = np.array([path[0] for path in paths])
        axes.plot(*starts.T, "o", color="black", markersize=4)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="box")
        params = ", ".join(f"{value:.2f}" for value in data.meta["params"])
        axes.set_title(f"task {data.task} ({data.meta['split']}): {params}", fontsize=9)
        axes.tick_params(labelsize=8)
    figure.colorbar(
        ScalarMappable(scale, "viridis"), ax=grid, label="return of the episode", extend="min"
    )
    names = ", ".join(tasks[0].meta["param_names"])
    figure.suptitle(f"Episodes of {len(tasks)} tasks, by {names}", fontsize="medium")


def _shown_episodes(data: TaskData) -> NDArray[np.int64]:
    """The first few episodes of every checkpoint, the earliest checkpoints first."""
    starts = np.flatnonzero(np.diff(data.episode, prepend=-1))
    marks = data.checkpoint[starts]
    chosen = [np.flatnonzero(marks == mark)[:EPISODES_A_CHECKPOINT] for mark in np.unique(marks)]
    return np.concatenate(chosen)


def _path(data: TaskData, episode: int) -> NDArray[np.float32]:
    """All observations of an episode, its last one included, [T + 1, 2]."""
    rows = data.episode == episode
    return np.concatenate([data.observations[rows], data.next_observations[rows][-1:]])


def _draw_histogram(axes: Axes, tasks: Sequence[TaskData]) -> None:
    """How many episodes have which return, early, middle and late checkpoints apart."""
    returns = np.concatenate([episode_returns(data.columns) for data in tasks])
    starts = [np.flatnonzero(np.diff(data.episode, prepend=-1)) for data in tasks]
    marks = np.concatenate([data.checkpoint[at] for data, at in zip(tasks, starts, strict=True)])
    thirds = np.array_split(np.unique(marks), min(3, len(np.unique(marks))))
    axes.hist(
        [returns[np.isin(marks, third)] for third in thirds],
        bins=40,
        stacked=True,
        color=["#c6d7ea", "#6f9fd0", TRAIN][-len(thirds) :],
        label=[f"checkpoints {third[0]:,} to {third[-1]:,}" for third in thirds],
    )
    axes.set_xlabel("return of an episode")
    axes.set_ylabel("episodes")
    axes.legend(frameon=False)
    axes.set_title(f"{len(returns):,} episodes of {len(tasks)} tasks")
