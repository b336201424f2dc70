"""The two shells around a Definition: one environment, and many side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.registry import definition, resolve, task_set
from meta_envs.tasks import TaskSet

RENDER_FPS = 10


def _check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    unknown = sorted(set(options or ()) - set(known))
    if unknown:
        raise ValueError(f"reset has no option {unknown[0]!r} (known: {', '.join(known)})")
    return dict(options or {})


def _check_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}")
    return render_mode


def _tasks_of(name: str, tasks: TaskSet | None) -> TaskSet:
    if tasks is None:
        return task_set(name)
    if tasks.env != name:
        raise ValueError(f"task_set belongs to '{tasks.env}', not to '{name}'")
    return tasks


def _check_action(action: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Actions as float64, clipped to [-1, 1]; a ValueError for a wrong shape or NaN."""
    checked = np.asarray(action, dtype=np.float64)
    if checked.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {checked.shape}")
    if np.isnan(checked).any():
        raise ValueError(f"action holds NaN: {checked.tolist()}")
    return np.minimum(np.maximum(checked, -1.0), 1.0)


class MetaEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A single environment on one task; make it with `gymnasium.make(id, task=3)`.

    `reset(options={"task": j})` moves to another task and stays there. `info` carries `task` and
    the reward's terms. The task is never in the observation. Actions are clipped to [-1, 1].
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
    }

    def __init__(
        self,
        name: str,
        task: int = 0,
        task_set: TaskSet | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Build the environment.

        Args:
            name: any of the environment's names.
            task: row of the task set.
            task_set: tasks to draw from instead of the environment's own, such as fresh ones
                from `TaskSet.sample`.
            render_mode: "rgb_array" or None.

        Raises:
            ValueError: unknown name, task out of range, foreign task set, unknown render mode.
        """
        self.definition = definition(name)
        self.task_set = _tasks_of(self.definition.name, task_set)
        self.observation_space = self.definition.observation_space
        self.action_space = self.definition.action_space
        self.render_mode = _check_render_mode(render_mode)
        self._shape = (1, *self.action_space.shape)
        self._state: Floats | None = None
        self._path: list[Floats] = []
        self._set_task(task)

    @property
    def task(self) -> int:
        """Row of the task set this environment is on."""
        return self._task

    def _set_task(self, task: object) -> None:
        self._task = self.task_set.check_task(task)
        self._params = self.task_set.params[self._task : self._task + 1]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; `options={"task": j}` moves to task j first."""
        checked = _check_options(options, ("task",))
        if "task" in checked:
            self._set_task(checked["task"])
        super().reset(seed=seed)
        self._state = self.definition.initial_state([self.np_random])
        self._path = [self._state]
        return self.definition.observe(self._state)[0], {"task": self._task}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of action [A]; `truncated` is False here, the time limit is a wrapper's."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        shape = self._shape[1:]
        actions = _check_action(action, shape)[None]
        state = self._state
        self._state = self.definition.advance(state, actions, self._params)
        reward, terms = self.definition.reward(state, actions, self._state, self._params)
        terminated = bool(self.definition.terminated(self._state)[0])
        if self.render_mode:
            self._path.append(self._state)
        info = {"task": self._task, **{key: value[0].item() for key, value in terms.items()}}
        return self.definition.observe(self._state)[0], float(reward[0]), terminated, False, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Picture [height, width, 3] of the episode so far; None unless in rgb_array mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs gymnasium.make(..., render_mode='rgb_array')")
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return self.definition.render(np.concatenate(self._path), self._params[0])


class _Generators(Sequence[np.random.Generator]):
    """One generator a sub-environment, made on first use: most environments never need them."""

    def __init__(self, seeds: Sequence[int | None]) -> None:
        self._seeds = seeds
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._seeds)

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)
        if index not in self._made:
            self._made[index] = seeding.np_random(self._seeds[index])[0]
        return self._made[index]

    def reseed(self, index: int, seed: int | None) -> None:
        """Start one sub-environment's stream anew."""
        self._made[index] = seeding.np_random(seed)[0]


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

        Raises:
            ValueError: any argument out of range, each named.
        """
        row = resolve(name)
        self.definition = definition(row.name)
        self.task_set = _tasks_of(row.name, task_set)
        chosen = [task] * num_envs if tasks is None else list(tasks)
        if tasks is not None and num_envs not in (1, len(chosen)):
            raise ValueError(f"num_envs={num_envs} but {len(chosen)} tasks were given")
        if not chosen:
            raise ValueError(f"{row.name}: at least one sub-environment is needed")
        self._tasks = np.array([self.task_set.check_task(t) for t in chosen], dtype=np.int64)
        self._params = self.task_set.params[self._tasks]
        self.num_envs = len(chosen)
        self.horizon = row.horizon if max_episode_steps is None else max_episode_steps
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = _check_render_mode(render_mode)
        self.single_observation_space = self.definition.observation_space
        self.single_action_space = self.definition.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._shape = (self.num_envs, *self.single_action_space.shape)
        self._every = np.ones(self.num_envs, dtype=np.bool_)
        self._generators = _Generators([None] * self.num_envs)
        self._state: Floats | None = None
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._over = np.zeros(self.num_envs, dtype=np.bool_)
        self._any_over = False
        self._paths: list[list[Floats]] = []

    @property
    def tasks(self) -> NDArray[np.int64]:
        """Task of each sub-environment, a copy, [num_envs]."""
        return self._tasks.copy()

    @property
    def state(self) -> Floats:
        """State of each sub-environment, [num_envs, S]; not to be written to."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._state

    @property
    def params(self) -> Floats:
        """Parameters of each sub-environment's task, [num_envs, P]; not to be written to."""
        return self._params

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: one integer (sub-environment i gets seed + i) or one for each.
            options: "task" (an integer or one for each) moves sub-environments to other tasks;
                "reset_mask" (bool [num_envs]) leaves the others as they are.
        """
        checked = _check_options(options, ("task", "reset_mask"))
        mask = self._check_mask(checked.get("reset_mask"))
        if "task" in checked:
            self._set_tasks(checked["task"], mask)
        if seed is not None:
            self._seed(seed, mask)
        start = self.definition.initial_state(self._generators)
        self._state = start if self._state is None else np.where(mask[:, None], start, self._state)
        self._elapsed[mask] = 0
        self._over = self._over & ~mask
        self._any_over = bool(self._over.any())
        if self.render_mode:
            self._start_paths(mask)
        return self.definition.observe(self._state), self._info({})

    def _check_mask(self, mask: object) -> NDArray[np.bool_]:
        if mask is None:
            return self._every
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            raise ValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) with at least one "
                f"True, got {mask!r}"
            )
        if self._state is None and not mask.all():
            raise gymnasium.error.ResetNeeded("the first reset must reset every sub-environment")
        return mask

    def _set_tasks(self, tasks: Any, mask: NDArray[np.bool_]) -> None:
        wanted = [tasks] * self.num_envs if np.ndim(tasks) == 0 else list(tasks)
        if len(wanted) != self.num_envs:
            raise ValueError(f"option 'task' needs {self.num_envs} tasks, got {len(wanted)}")
        rows = np.array([self.task_set.check_task(t) for t in wanted], dtype=np.int64)
        self._tasks = np.where(mask, rows, self._tasks)
        self._params = self.task_set.params[self._tasks]

    def _seed(self, seed: int | list[int | None], mask: NDArray[np.bool_]) -> None:
        seeds = (
            [int(seed) + i for i in range(self.num_envs)]
            if isinstance(seed, int | np.integer)
            else list(seed)
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"{self.num_envs} seeds are needed, got {len(seeds)}")
        if mask.all():
            self._generators = _Generators(seeds)
            return
        for index in np.flatnonzero(mask):
            self._generators.reseed(int(index), seeds[index])

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of actions [num_envs, A] in every sub-environment."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        checked = _check_action(actions, self._shape)
        skipped = self._over if self._any_over else None
        if skipped is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {np.flatnonzero(skipped).tolist()} are over: call "
                "reset(options={'reset_mask': mask}) first, or choose another autoreset_mode"
            )
        state = self._state
        next_state = self.definition.advance(state, checked, self._params)
        reward, terms = self.definition.reward(state, checked, next_state, self._params)
        terminated = self.definition.terminated(next_state)
        self._elapsed += 1
        if skipped is not None:
            next_state = self._restart(skipped, next_state)
            reward[skipped] = 0.0
            terminated &= ~skipped
            terms = {
                key: np.where(skipped, value.dtype.type(0), value) for key, value in terms.items()
            }
        truncated = self._elapsed >= self.horizon
        if self.render_mode:
            self._extend_paths(next_state, skipped)
        self._state = next_state
        self._over = terminated | truncated
        self._any_over = bool(self._over.any())
        info = self._info(terms)
        if self._any_over and self.autoreset_mode is AutoresetMode.SAME_STEP:
            info = self._reset_finished(info)
        return self.definition.observe(self._state), reward, terminated, truncated, info

    def _restart(self, mask: NDArray[np.bool_], state: Floats) -> Floats:
        """States with the masked sub-environments at the start of an episode."""
        start = self.definition.initial_state(self._generators)
        self._elapsed[mask] = 0
        return np.where(mask[:, None], start, state)

    def _reset_finished(self, info: dict[str, Any]) -> dict[str, Any]:
        assert self._state is not None
        over = self._over
        last = self.definition.observe(self._state)
        self._state = self._restart(over, self._state)
        if self.render_mode:
            self._start_paths(over)
        self._over = np.zeros_like(over)
        self._any_over = False
        return {
            **info,
            "final_obs": last,
            "_final_obs": over.copy(),
            "final_info": info,
            "_final_info": over.copy(),
        }

    def _info(self, terms: Terms) -> dict[str, Any]:
        """Gymnasium's vector info: an array a key, and a mask `_key` of where it holds."""
        info: dict[str, Any] = {"task": self._tasks.copy(), "_task": self._every.copy()}
        for key, value in terms.items():
            info[key] = value
            info["_" + key] = self._every.copy()
        return info

    def _start_paths(self, mask: NDArray[np.bool_]) -> None:
        assert self._state is not None
        if not self._paths:
            self._paths = [[] for _ in range(self.num_envs)]
        for index in np.flatnonzero(mask):
            self._paths[index] = [self._state[index]]

    def _extend_paths(self, state: Floats, restarted: NDArray[np.bool_] | None) -> None:
        for index, path in enumerate(self._paths):
            if restarted is not None and restarted[index]:
                path.clear()
            path.append(state[index])

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture [height, width, 3] a sub-environment; None unless in rgb_array mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs make_vec(..., render_mode='rgb_array')")
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return tuple(
            self.definition.render(np.stack(path), params)
            for path, params in zip(self._paths, self._params, strict=True)
        )
