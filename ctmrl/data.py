"""The training tasks' offline data as one table in memory, sampled by one gather."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.errors import UsageError
from ctmrl.networks import Statistics
from datagen.dataset import Dataset, TaskData


class Transitions(NamedTuple):
    """A batch for the actor-critic; n rows, task by task.

    Attributes:
        obs: [n, O].
        action: [n, A].
        reward: [n], the dense one where an environment has both.
        next_obs: [n, O].
        terminal: [n], 1.0 where the value of next_obs does not count.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminal: Tensor


@dataclass(frozen=True)
class _Layout:
    """Which columns of the table hold what."""

    obs_dim: int
    act_dim: int

    @property
    def context(self) -> slice:
        return slice(0, 2 * self.obs_dim + self.act_dim + 1)


class OfflineData:
    """Transitions of T tasks in one float32 table: (s, a, r, s') for contexts, then (r, terminal).

    Tasks are counted 0..T-1 here, in the order they were given.

    Attributes:
        tasks: int64 [T], the tasks' rows in the environment's task set.
        obs_dim: O.
        act_dim: A.
        params: float32 [T, P], the tasks' true parameters, which no method but a reference sees.
    """

    def __init__(
        self,
        dataset: Dataset,
        tasks: NDArray[np.int64],
        timeouts_as_terminals: bool = False,
        dense_context: bool = False,
    ) -> None:
        """Read the tasks.

        Args:
            dataset: an open dataset, or a slice of one.
            tasks: rows of the task set; nothing of other tasks is read.
            timeouts_as_terminals: treat the time limit as a real end, the field's habit.
            dense_context: on a sparse environment, let contexts see the dense reward.

        Raises:
            DatasetError: a file is damaged, or a task has nothing in the slice.
        """
        self.tasks = np.asarray(tasks, dtype=np.int64)
        self._part = dataset.part
        rows = np.searchsorted(dataset.tasks, self.tasks)
        self.params = torch.tensor(dataset.params[rows], dtype=torch.float32)
        tables, lengths = [], []
        for task in tasks:
            # One task's columns at a time: of the others there are only rows of the table.
            data = dataset.read(int(task))
            self.obs_dim, self.act_dim = data.observations.shape[1], data.actions.shape[1]
            tables.append(_rows(data, timeouts_as_terminals, dense_context))
            lengths.append(np.bincount(data.episode))
        self._layout = _Layout(self.obs_dim, self.act_dim)
        self.table = torch.from_numpy(np.concatenate(tables))
        self._task_rows = torch.tensor([len(rows) for rows in tables])
        self._task_start = torch.cumsum(self._task_rows, 0) - self._task_rows
        self._task_episodes = torch.tensor([len(counts) for counts in lengths])
        self._task_first_episode = torch.cumsum(self._task_episodes, 0) - self._task_episodes
        self._episode_rows = torch.from_numpy(np.concatenate(lengths))
        self._episode_start = torch.cumsum(self._episode_rows, 0) - self._episode_rows

    def __len__(self) -> int:
        """Number of tasks T."""
        return len(self.tasks)

    @property
    def episodes(self) -> int:
        """Number of episodes of the task that has fewest."""
        return int(self._task_episodes.min())

    def statistics(self, next_obs_in_context: bool) -> Statistics:
        """Mean and standard deviation of the columns and parameters, over all tasks here."""
        obs = self.table[:, : self.obs_dim]
        context = self.table[:, self._layout.context]
        change = context[:, -self.obs_dim :] - obs
        before = context[:, : -self.obs_dim]
        seen = torch.cat([before, change], dim=1) if next_obs_in_context else before
        target = torch.cat([before[:, -1:], change], dim=1)
        columns = (obs, seen, target, self.params)
        return Statistics(*((x.mean(dim=0), x.std(dim=0)) for x in columns))

    def transitions(self, tasks: Tensor, n: int, generator: torch.Generator) -> Transitions:
        """Draw n transitions a task, uniformly with replacement, [B * n, ...]."""
        draw = torch.rand(len(tasks), n, generator=generator)
        offset = (draw * self._task_rows[tasks][:, None]).long()
        rows = (self._task_start[tasks][:, None] + offset).flatten()
        return self.unpack(self.table.index_select(0, rows))

    def unpack(self, rows: Tensor) -> Transitions:
        """Split table rows [n, F] into a batch."""
        o, a = self.obs_dim, self.act_dim
        obs, action, _, next_obs, reward, terminal = torch.split(rows, [o, a, 1, o, 1, 1], dim=-1)
        return Transitions(obs, action, reward[:, 0], next_obs, terminal[:, 0])

    def check_episodes(self, sets: int, episodes: int) -> None:
        """Check that every task has the episodes that `contexts` needs.

        Raises:
            UsageError: a task has fewer than sets * episodes episodes.
        """
        if sets * episodes > self.episodes:
            where, more = ("dataset", "collect") if self._part.whole else ("slice", "ask for")
            raise UsageError(
                f"contexts need {sets} x {episodes} different episodes a task, the {where} has "
                f"{self.episodes}: {more} more or lower --context-episodes"
            )

    def contexts(
        self, tasks: Tensor, sets: int, episodes: int, n: int, generator: torch.Generator
    ) -> Tensor:
        """Draw contexts: `sets` of them a task, no episode in two of a task's.

        Args:
            tasks: [B] of 0..T-1.
            sets: contexts a task, 2 for an anchor and its positive.
            episodes: episodes behind each context.
            n: transitions of each context, uniform over the rows of its episodes.
            generator: of all draws.

        Returns:
            [sets, B, n, O + A + 1 + O], transitions (s, a, r, s').

        Raises:
            UsageError: a task has fewer than sets * episodes episodes.
        """
        self.check_episodes(sets, episodes)
        count = self._task_episodes[tasks]
        keys = torch.rand(len(tasks), int(count.max()), generator=generator)
        keys.masked_fill_(torch.arange(keys.shape[1]) >= count[:, None], 2.0)
        # The smallest random keys name distinct episodes.
        chosen = keys.topk(sets * episodes, dim=1, largest=False, sorted=False).indices
        chosen = chosen + self._task_first_episode[tasks][:, None]
        pick = torch.rand(len(tasks), sets, n, generator=generator)
        lengths = self._episode_rows[chosen].view(len(tasks), sets, episodes)
        ends = lengths.cumsum(dim=2)
        offset = (pick * ends[..., -1:]).long()
        which = torch.searchsorted(ends, offset, right=True)
        start = self._episode_start[chosen].view(len(tasks), sets, episodes)
        within = offset - (ends - lengths).gather(2, which)
        rows = (start.gather(2, which) + within).transpose(0, 1).flatten()
        width = self._layout.context.stop
        gathered = self.table.index_select(0, rows)[:, :width]
        return gathered.view(sets, len(tasks), n, width)


def _rows(data: TaskData, timeouts_as_terminals: bool, dense_context: bool) -> NDArray[np.float32]:
    columns = data.columns
    terminal = columns["terminals"]
    if timeouts_as_terminals:
        terminal = terminal | columns["timeouts"]
    learned = columns.get("dense_rewards", columns["rewards"])
    return np.concatenate(
        [
            columns["observations"],
            columns["actions"],
            (learned if dense_context else columns["rewards"])[:, None],
            columns["next_observations"],
            learned[:, None],
            terminal[:, None],
        ],
        axis=1,
        dtype=np.float32,
    )
