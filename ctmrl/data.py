"""The training tasks' offline data as one table, sampled by one gather."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.errors import UsageError
from ctmrl.networks import Statistics
from ctmrl.table import Room
from datagen.dataset import Dataset, TaskData


class Transitions(NamedTuple):
    """A batch for the actor-critic; n rows, task by task.

    Attributes:
        obs: [n, O].
        action: [n, A].
        reward: [n], the dense one where an environment has both.
        next_obs: [n, O].
        terminal: [n], 1.0 where the value of next_obs does not count.
        rank: [n], from 0 to below 1, the share of the task's rows that are of episodes with lower
            returns than the row's own, by this reward.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminal: Tensor
    rank: Tensor


def split_batches(drawn: Transitions, tasks: int, batches: int) -> list[Transitions]:
    """Split rows [tasks * batches * n, ...], task by task, into batches [tasks * n, ...]."""
    columns = [one.view(tasks, batches, -1, *one.shape[1:]).unbind(1) for one in drawn]
    return [Transitions(*(x.flatten(0, 1) for x in parts)) for parts in zip(*columns, strict=True)]


@dataclass(frozen=True)
class _Layout:
    """Which columns of the table hold what."""

    obs_dim: int
    act_dim: int

    @property
    def reward(self) -> int:
        return self.obs_dim + self.act_dim

    @property
    def context(self) -> int:
        """Where the part for contexts ends."""
        return self.reward + 1 + self.obs_dim

    @property
    def width(self) -> int:
        return self.context + 3


class OfflineData:
    """Transitions of T tasks in one float32 table: (s, a, r, s'), then (r, terminal, rank).

    The first part is for contexts. Tasks are counted 0..T-1 here, in the order they were given, and
    their rows follow each other in that order: [T, row, feature] for tasks of any lengths. The
    table is the only copy, filled a block of rows at a time.

    Attributes:
        tasks: int64 [T], the tasks' rows in the environment's task set.
        obs_dim: O.
        act_dim: A.
        params: float32 [T, P], the tasks' true parameters, which no method but a reference sees.
        table: [N, 2 O + A + 4].
        device: where what is drawn lies, and the table too unless it is in a file.
        largest_reward: largest absolute reward the actor-critic learns from.
    """

    def __init__(
        self,
        dataset: Dataset,
        tasks: NDArray[np.int64],
        timeouts_as_terminals: bool = False,
        dense_context: bool = False,
        room: Room | None = None,
    ) -> None:
        """Read the tasks.

        Args:
            dataset: an open dataset, or a slice of one.
            tasks: rows of the task set; nothing of other tasks is read.
            timeouts_as_terminals: treat the time limit as a real end, the field's habit.
            dense_context: on a sparse environment, let contexts see the dense reward.
            room: where the table may lie.

        Raises:
            DatasetError: a file is damaged, or a task has nothing in the slice.
            UsageError: there is no room for the table.
        """
        self.tasks = np.asarray(tasks, dtype=np.int64)
        self._part = dataset.part
        at = np.searchsorted(dataset.tasks, self.tasks)
        self.params = torch.tensor(dataset.params[at], dtype=torch.float32)
        lengths = [dataset.episodes(int(task)).lengths for task in tasks]
        self.device = torch.device("cpu")
        self._task_rows = torch.tensor([int(rows.sum()) for rows in lengths])
        self._task_start = torch.cumsum(self._task_rows, 0) - self._task_rows
        self._task_episodes = torch.tensor([len(rows) for rows in lengths])
        self._task_first_episode = torch.cumsum(self._task_episodes, 0) - self._task_episodes
        self._episode_rows = torch.from_numpy(np.concatenate(lengths))
        self._episode_start = torch.cumsum(self._episode_rows, 0) - self._episode_rows
        first = next(dataset.blocks(int(tasks[0]), rows=1))
        self.obs_dim, self.act_dim = first.observations.shape[1], first.actions.shape[1]
        self._layout = _Layout(self.obs_dim, self.act_dim)
        self._table = (room or Room()).table(int(self._task_rows.sum()), self._layout.width)
        self.table = self._table.values
        rows_of = partial(
            _rows, timeouts_as_terminals=timeouts_as_terminals, dense_context=dense_context
        )
        # Twice, because the statistics are of the changes s' - s: so they need no second table.
        self._fill(dataset, lambda data: _with_changes(rows_of(data), self._layout))
        self._statistics = {seen: self._measure(seen) for seen in (False, True)}
        ranks = self._ranks(self.table[:, self._layout.context])
        self._fill(dataset, rows_of, ranks.repeat_interleave(self._episode_rows))
        # Now, because after this to read all rows in their order is slow.
        learned = self.unpack(self.table)
        self.largest_reward = float(learned.reward.abs().max())
        self._mean_reward, self._end_rate = map(
            float, (learned.reward.mean(), learned.terminal.mean())
        )
        self._table.filled()

    def _fill(
        self,
        dataset: Dataset,
        rows_of: Callable[[TaskData], NDArray[np.float32]],
        rank: Tensor | None = None,
    ) -> None:
        start = 0
        for task in self.tasks:
            for block in dataset.blocks(int(task)):
                end = start + len(block)
                self.table[start:end, :-1] = torch.from_numpy(rows_of(block))
                if rank is not None:
                    self.table[start:end, -1] = rank[start:end]
                start = end

    def _measure(self, next_obs_in_context: bool) -> Statistics:
        """The statistics, while the table has changes in place of next observations."""
        reward, context = self._layout.reward, self._layout.context
        seen = context if next_obs_in_context else reward + 1
        # A single task has no spread.
        spread = self.params.std(dim=0, correction=min(1, len(self) - 1))
        return Statistics(
            obs=_moments(self.table[:, : self.obs_dim]),
            context=_moments(self.table[:, :seen]),
            target=_moments(self.table[:, reward:context]),
            params=(self.params.mean(dim=0), spread),
        )

    def _ranks(self, reward: Tensor) -> Tensor:
        """The rank of each episode, from the rewards of all rows."""
        returns = torch.segment_reduce(reward, "sum", lengths=self._episode_rows)
        counts = self._task_episodes.tolist()
        ranks = []
        both = (torch.split(x, counts) for x in (returns, self._episode_rows))
        for own, rows in zip(*both, strict=True):
            ordered, order = own.sort()
            below = rows[order].cumsum(0) - rows[order]
            # Of episodes with one return, the first in order has all those below it.
            ranks.append(below[torch.searchsorted(ordered, own)] / rows.sum())
        return torch.cat(ranks)

    def __len__(self) -> int:
        """Number of tasks T."""
        return len(self.tasks)

    @property
    def episodes(self) -> int:
        """Number of episodes of the task that has fewest."""
        return int(self._task_episodes.min())

    def mean_value(self, gamma: float) -> float:
        """Discounted sum of rewards that are the data's mean, and end as often as the data do."""
        return self._mean_reward / max(1 - gamma * (1 - self._end_rate), 1e-6)

    @property
    def in_file(self) -> bool:
        """Whether the table is in a file instead of in memory."""
        return self._table.in_file

    def to(self, device: torch.device) -> None:
        """Have all that is drawn on a device, and there the table, if it is in memory.

        Raises:
            UsageError: the device has no room for the table.
        """
        if device == self.device:
            return
        self.device, self.params = device, self.params.to(device)
        if not self.in_file:
            try:
                self.table = self._table.values = self.table.to(device)
            except torch.OutOfMemoryError:
                raise UsageError(
                    f"the training data take {self.table.nbytes / 1e9:.2f} GB as a table, more "
                    f"than {device} has: --memory 0 keeps them in a file"
                ) from None

    def _gather(self, rows: Tensor) -> Tensor:
        """Rows of the table, numbers [n] on the host, on the device."""
        return self.table.index_select(0, rows.to(self.table.device)).to(self.device)

    def page_in(self, rows: Tensor) -> None:
        """Begin to read rows of the table from its file, if it is in one; returns at once."""
        self._table.page_in(rows)

    def statistics(self, next_obs_in_context: bool) -> Statistics:
        """Mean and standard deviation of the columns and parameters, over all tasks here."""
        return self._statistics[next_obs_in_context]

    def transitions(self, tasks: Tensor, n: int, generator: torch.Generator) -> Transitions:
        """Draw n transitions a task, uniformly with replacement, [B * n, ...]."""
        return self.unpack(self._gather(self.batch_rows(tasks, n, generator)))

    def batch_rows(self, tasks: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """The rows of the table that `transitions` draws."""
        draw = torch.rand(len(tasks), n, generator=generator)
        offset = (draw * self._task_rows[tasks][:, None]).long()
        return (self._task_start[tasks][:, None] + offset).flatten()

    def unpack(self, rows: Tensor) -> Transitions:
        """Split table rows [n, F] into a batch."""
        o, a = self.obs_dim, self.act_dim
        obs, action, _, next_obs, last = torch.split(rows, [o, a, 1, o, 3], dim=-1)
        reward, terminal, rank = last.unbind(dim=-1)
        return Transitions(obs, action, reward, next_obs, terminal, rank)

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
        rows = self.context_rows(tasks, sets, episodes, n, generator)
        width = self._layout.context
        gathered = self._gather(rows)[:, :width]
        return gathered.view(sets, len(tasks), n, width)

    def context_rows(
        self, tasks: Tensor, sets: int, episodes: int, n: int, generator: torch.Generator
    ) -> Tensor:
        """The rows of the table that `contexts` draws, [sets * B * n]."""
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
        return (start.gather(2, which) + within).transpose(0, 1).flatten()


def _moments(columns: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each column, [n, D] -> two of [D]."""
    return columns.mean(dim=0), columns.std(dim=0)


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


def _with_changes(rows: NDArray[np.float32], layout: _Layout) -> NDArray[np.float32]:
    """The same rows with s' - s in place of s'."""
    rows[:, layout.reward + 1 : layout.context] -= rows[:, : layout.obs_dim]
    return rows
