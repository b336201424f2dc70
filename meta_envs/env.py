"""The two shells around a Definition: one environment, and many side by side."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from meta_envs import checks
from meta_envs.definition import Definition, Floats, Terms
from meta_envs.registry import OwnTasks, chosen_tasks, definition, resolve
from meta_envs.streams import Streams
from meta_envs.tasks import TaskSet


def _processors() -> int:
    """Number of processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class MetaEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A single environment on one task; make it with `gymnasium.make(id, task=3)`.

    `reset(options={"task": j})` moves to another task and stays there. `info` carries `task` and
    the reward's terms. The task is never in the observation. Actions are clipped to [-1, 1].
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - every instance has its own
        "render_modes": ["rgb_array"],
        "render_fps": Definition.render_fps,
    }

    def __init__(
        self,
        name: str,
        task: int = 0,
        task_set: TaskSet | None = None,
        render_mode: str | None = None,
        task_params: Mapping[str, float] | None = None,
    ) -> None:
        """Build the environment.

        Args:
            name: any of the environment's names.
            task: row of the task set.
            task_set: tasks to draw from instead of the environment's own, such as fresh ones
                from `TaskSet.sample`.
            render_mode: "rgb_array" or None.
            task_params: a task of one's own instead, a number for each of the parameters.

        Raises:
            ValueError: unknown name, task out of range, foreign task set, wrong task_params,
                unknown render mode.
            ImportError: the environment needs MuJoCo, or a newer one.
        """
        self.definition = definition(name)
        self.task_set = chosen_tasks(self.definition.name, task_set, task_params)
        # Copies, because a space holds the generator its samples come from.
        self.observation_space = copy.deepcopy(self.definition.observation_space)
        self.action_space = copy.deepcopy(self.definition.action_space)
        self.render_mode = checks.check_render_mode(render_mode)
        self.metadata = {**MetaEnv.metadata, "render_fps": self.definition.render_fps}
        self._shape = self.definition.action_space.shape
        self._state: Floats | None = None
        self._path: list[Floats] = []
        row = self.task_set.check_task(task)
        self._simulation = self.definition.simulation(1)
        self._set_task(row)

    @property
    def task(self) -> int:
        """Row of the task set this environment is on."""
        return self._task

    @property
    def state(self) -> Floats:
        """Its state, [S], read-only."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        view: Floats = self._state[0]
        view.setflags(write=False)
        return view

    def _set_task(self, task: int) -> None:
        self._task = task
        self._params = self.task_set.params[task : task + 1]
        self._simulation.set_params(self._params)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; `options={"task": j}` moves to task j first."""
        checked = checks.check_options(options, ("task",))
        task = self.task_set.check_task(checked.get("task", self._task))
        super().reset(seed=seed)
        self._set_task(task)
        self._state = self.definition.initial_state([self.np_random])
        self._path = [self._state]
        return self.definition.observe(self._state)[0], {"task": self._task}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of action [A]; `truncated` is False here, the time limit is a wrapper's."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        actions = checks.check_action(action, self._shape)[None]
        state = self._state
        self._state = self._simulation.step(state, actions)
        reward, terms = self.definition.reward(state, actions, self._state, self._params)
        terminated = bool(self.definition.terminated(self._state)[0])
        if self.render_mode:
            self._path.append(self._state)
        info = {"task": self._task, **{key: value[0].item() for key, value in terms.items()}}
        return self.definition.observe(self._state)[0], float(reward[0]), terminated, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Picture [height, width, 3] of the episode so far; None unless in rgb_array mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs gymnasium.make(..., render_mode='rgb_array')")
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return self.definition.render(np.concatenate(self._path), self._params[0])


class MetaVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """Sub-environments side by side, each on a task of its own, one row each.

    Make it with `gymnasium.make_vec(id, vectorization_mode="vector_entry_point", tasks=[3, 5])`.
    Every array it returns is fresh. Its numbers equal those of `MetaEnv` bit for bit.
    Truncation comes from the time limit alone.
    """

    def __init__(  # noqa: PLR0913 - the keywords gymnasium.make_vec passes on
        self,
        name: str,
        num_envs: int = 1,
        tasks: Sequence[int] | NDArray[np.int64] | None = None,
        task: int = 0,
        task_set: TaskSet | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        threads: int | None = None,
        task_params: OwnTasks | None = None,
    ) -> None:
        """Build the sub-environments.

        Args:
            name: any of the environment's names.
            num_envs: number of sub-environments; taken from `tasks` if that is given.
            tasks: task of each sub-environment.
            task: task of all of them where `tasks` is not given.
            task_set: tasks to draw from instead of the environment's own.
            max_episode_steps: time limit; the environment's horizon by default.
            autoreset_mode: `AutoresetMode` or its value: "NextStep" resets a finished
                sub-environment in the step after, "SameStep" at once (its last observation and info
                are in `info["final_obs"]` and `info["final_info"]`), "Disabled" leaves it to
                `reset(options={"reset_mask": mask})`.
            render_mode: "rgb_array" or None.
            threads: native threads that step the sub-environments, where the environment can use
                any; by default as many as there are processors for this process. More than
                sub-environments are never used. The numbers do not depend on it.
            task_params: tasks of one's own instead of a set: a number for each of the parameters,
                or a sequence of such mappings, then one sub-environment each.

        Raises:
            ValueError: any argument out of range, each named.
            ImportError: the environment needs MuJoCo, or a newer one.
        """
        row = resolve(name)
        self.definition = definition(row.name)
        self.task_set = chosen_tasks(row.name, task_set, task_params)
        if tasks is None and isinstance(task_params, Sequence):
            tasks = range(len(task_params))
        count = checks.check_positive("num_envs", num_envs)
        self._tasks = checks.check_rows([task] * count if tasks is None else tasks, self.task_set)
        self.num_envs = len(self._tasks)
        if count not in (1, self.num_envs):
            raise ValueError(f"num_envs={count} but {self.num_envs} tasks were given")
        limit = row.horizon if max_episode_steps is None else max_episode_steps
        self.horizon = checks.check_positive("max_episode_steps", limit)
        self.autoreset_mode = checks.check_autoreset_mode(autoreset_mode)
        self.render_mode = checks.check_render_mode(render_mode)
        self.metadata = {
            **MetaEnv.metadata,
            "render_fps": self.definition.render_fps,
            "autoreset_mode": self.autoreset_mode,
        }
        # Copies, because a space holds the generator its samples come from.
        self.single_observation_space = copy.deepcopy(self.definition.observation_space)
        self.single_action_space = copy.deepcopy(self.definition.action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._shape = (self.num_envs, *self.definition.action_space.shape)
        wanted = _processors() if threads is None else checks.check_positive("threads", threads)
        self.threads = min(wanted, self.num_envs)
        self._simulation = self.definition.simulation(self.num_envs, self.threads)
        self._set_params()
        self._streams = Streams([None] * self.num_envs)
        self._state: Floats | None = None
        self._every = np.ones(self.num_envs, dtype=np.bool_)
        self._over = self._resting = ~self._every
        self._any_over = self._any_resting = False
        self._clock = 0
        self._deadlines = np.zeros(self.num_envs, dtype=np.int64)
        self._first_deadline = 0
        self._paths: list[list[Floats]] = [[] for _ in range(self.num_envs)]

    def _set_params(self) -> None:
        self._params: Floats = self.task_set.params[self._tasks]
        self._params.setflags(write=False)
        self._simulation.set_params(self._params)

    @property
    def tasks(self) -> NDArray[np.int64]:
        """Task of each sub-environment, a copy, [num_envs]."""
        return self._tasks.copy()

    @property
    def state(self) -> Floats:
        """State of each sub-environment, [num_envs, S], read-only."""
        view = self._started().view()
        view.setflags(write=False)
        return view

    @property
    def params(self) -> Floats:
        """Parameters of each sub-environment's task, [num_envs, P], read-only."""
        return self._params

    def _started(self) -> Floats:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._state

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: one integer (sub-environment i gets seed + i) or one for each; a sub-environment
                without one goes on with its random stream.
            options: "task" (an integer or one for each) moves sub-environments to other tasks;
                "reset_mask" (bool [num_envs]) leaves the others as they are.
        """
        checked = checks.check_options(options, ("task", "reset_mask"))
        mask = self._every
        if checked.get("reset_mask") is not None:
            mask = checks.check_mask("reset_mask", checked["reset_mask"], self.num_envs)
        if self._state is None and not mask.all():
            raise gymnasium.error.ResetNeeded("the first reset must reset every sub-environment")
        tasks = self._tasks
        if "task" in checked:
            tasks = checks.check_asked(checked["task"], self.task_set, self.num_envs)
        seeds = None if seed is None else checks.check_seeds(seed, self.num_envs)
        self._tasks = np.where(mask, tasks, self._tasks)
        self._set_params()
        if seeds is not None:
            for index in np.flatnonzero(mask).tolist():
                self._streams.reseed(index, seeds[index])
        self._state = self._restart(mask, self._state)
        self._over = self._over & ~mask
        self._any_over = bool(self._over.any())
        self._resting = self._resting & ~mask
        self._any_resting = bool(self._resting.any())
        self._start_paths(mask)
        return self.definition.observe(self._state), self._info({}, self._every)

    def rest(self, mask: NDArray[np.bool_]) -> None:
        """Let masked sub-environments [num_envs] stand still until they are reset.

        A step does not simulate them, and gives them a reward of 0, no end and the observation that
        they have; the masks of the reward's terms are False for them.
        """
        self._started()
        self._resting = self._resting | checks.check_mask("mask", mask, self.num_envs)
        self._any_resting = True
        self._over = self._over & ~self._resting
        self._any_over = bool(self._over.any())

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of actions [num_envs, A] in every sub-environment.

        In the mode "NextStep" a sub-environment that was over is reset instead: its action is
        ignored, its reward is 0 and the masks of the reward's terms are False for it.
        """
        state = self._started()
        checked = checks.check_action(actions, self._shape)
        if self._any_over and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {np.flatnonzero(self._over).tolist()} are over: call "
                "reset(options={'reset_mask': mask}) first, or choose another autoreset_mode"
            )
        going = self._every
        if self._any_over or self._any_resting:
            going = ~(self._over | self._resting)
        next_state = self._simulation.step(state, checked, None if going is self._every else going)
        if self._any_resting:
            next_state = np.where(self._resting[:, None], state, next_state)
        reward, terms = self.definition.reward(state, checked, next_state, self._params)
        terminated = self.definition.terminated(next_state)
        self._state = next_state
        self._clock += 1
        if self._any_over:
            self._state = self._restart(self._over, next_state)
            self._start_paths(self._over)
        truncated = self._truncated()
        if going is not self._every:
            for values in (reward, terminated, truncated, *terms.values()):
                values[~going] = 0
        self._extend_paths(going)
        self._over = terminated | truncated
        self._any_over = bool(np.count_nonzero(self._over))
        info = self._info(terms, going)
        if self._any_over and self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._reset_finished(info)
        return self.definition.observe(self._state), reward, terminated, truncated, info

    def _truncated(self) -> NDArray[np.bool_]:
        """Whose time is up; nearly always nobody's, and then nothing is compared."""
        if self._clock < self._first_deadline:
            return np.zeros(self.num_envs, np.bool_)
        return self._deadlines <= self._clock

    def _restart(self, mask: NDArray[np.bool_], state: Floats | None) -> Floats:
        """States with the masked sub-environments at the start of an episode."""
        rows = np.flatnonzero(mask)
        self._deadlines[rows] = self._clock + self.horizon
        self._first_deadline = int(self._deadlines.min())
        start = self.definition.initial_state(self._streams.of(rows.tolist()))
        if state is None or len(rows) == self.num_envs:
            return start
        fresh = state.copy()
        fresh[rows] = start
        return fresh

    def _reset_finished(self, info: dict[str, Any]) -> None:
        """Reset what is over and add its last observation and info to `info`."""
        state, over = self._started(), self._over
        last_info = {key: value.copy() for key, value in info.items()}
        for key in info:
            if key.startswith("_"):
                last_info[key] &= over
        info["final_obs"], info["_final_obs"] = self.definition.observe(state), over.copy()
        info["final_info"], info["_final_info"] = last_info, over.copy()
        self._state = self._restart(over, state)
        self._start_paths(over)
        self._over = np.zeros_like(over)
        self._any_over = False

    def _info(self, terms: Terms, holds: NDArray[np.bool_]) -> dict[str, Any]:
        """Gymnasium's vector info: an array a key, and a mask `_key` of where it holds."""
        info: dict[str, Any] = {"task": self._tasks.copy(), "_task": self._every.copy()}
        for key, value in terms.items():
            info[key] = value
            info["_" + key] = holds.copy()
        return info

    def _start_paths(self, mask: NDArray[np.bool_]) -> None:
        if self.render_mode:
            state = self._started()
            for index in np.flatnonzero(mask):
                self._paths[index] = [state[index]]

    def _extend_paths(self, mask: NDArray[np.bool_]) -> None:
        if self.render_mode:
            state = self._started()
            for index in np.flatnonzero(mask):
                self._paths[index].append(state[index])

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture [height, width, 3] a sub-environment; None unless in rgb_array mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs make_vec(..., render_mode='rgb_array')")
            return None
        self._started()
        return tuple(
            self.definition.render(np.stack(path), params)
            for path, params in zip(self._paths, self._params, strict=True)
        )
