"""Environments with one fault each, and one without: what conformance checks must tell apart."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.tasks import Split, TaskSet
from tests.meta_envs.noisy_robot import NoisyRobot

_rng = np.random.default_rng


def _sample(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.uniform(-1.0, 1.0, (n_tasks, 2))


class Sound(NoisyRobot):
    """Nothing is wrong with it; its subclasses are called by their classes' names."""

    name: ClassVar[str] = "sound"

    def __init_subclass__(cls) -> None:
        cls.name = re.sub("(?<!^)([A-Z])", r"_\1", cls.__name__).lower()

    def tasks(self) -> TaskSet:
        return self.set_of()

    def set_of(self, **changes: Any) -> TaskSet:
        content: dict[str, Any] = {
            "params": _rng(5).uniform(-1.0, 1.0, (6, 2)),
            "test_tasks": np.array([1, 4]),
            "sampler": _sample,
        }
        return TaskSet(self.name, self.param_names, **{**content, **changes})


class ShortName(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.__dict__["name"] = "short"


class WideActions(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.action_space = Box(-2.0, 2.0, (2,), np.float32)


class NoSpace(Sound):
    def __init__(self) -> None:
        super().__init__()
        del self.observation_space


class DoubleSpace(Sound):
    def __init__(self) -> None:
        super().__init__()
        double: Any = np.float64
        self.observation_space = Box(-3.0, 3.0, (2,), double)


class CannotBeMade(Sound):
    def __init__(self) -> None:
        raise RuntimeError("no licence")


class SingleReward(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, terms = super().reward(*given)
        single: Any = reward.astype(np.float32)
        return single, terms


class WritesIntoStates(Sound):
    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        state += 0.1 * action
        return state.copy()


class SharesMemory(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, terms = super().reward(*given)
        return reward, {**terms, "cost": reward}


class TermsDoNotAddUp(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, _ = super().reward(*given)
        return reward, {"reward_goal": reward.copy(), "reward_alive": np.ones(len(reward))}


class RewardOfNan(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, terms = super().reward(*given)
        return reward * np.nan, terms


class ReservedTerm(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, _ = super().reward(*given)
        return reward, {"task": reward.copy()}


class SparseAlone(Sound):
    sparse: ClassVar[bool] = True


class OtherTasksEachTime(Sound):
    made: ClassVar[list[int]] = []

    def tasks(self) -> TaskSet:
        self.made.append(0)
        return self.set_of(params=_rng(len(self.made)).uniform(-1.0, 1.0, (6, 2)))


class TwinTasks(Sound):
    def tasks(self) -> TaskSet:
        return self.set_of(params=np.repeat(_rng(5).uniform(-1.0, 1.0, (3, 2)), 2, axis=0))


class ForeignTasks(Sound):
    def tasks(self) -> TaskSet:
        own = self.set_of()
        return TaskSet("other", own.param_names, own.params, own.test_tasks, own.sampler)


class OverlappingSplit(Sound):
    def tasks(self) -> TaskSet:
        return self.set_of(splits={"far": Split(np.arange(4), np.arange(3, 6))})


class EmptySplit(Sound):
    def tasks(self) -> TaskSet:
        return self.set_of(test_tasks=np.arange(6))


class NothingOutside(Sound):
    def tasks(self) -> TaskSet:
        line = np.stack([np.linspace(0.0, 1.0, 6), np.zeros(6)], axis=1)
        between = Split(np.array([0, 2, 4]), np.array([1, 5]))
        return self.set_of(params=line, splits={"extrapolate": between})


class SamplerWithoutSeed(Sound):
    def tasks(self) -> TaskSet:
        return self.set_of(sampler=lambda generator, n: _sample(_rng(3), n))


class SamplerOfChance(Sound):
    def tasks(self) -> TaskSet:
        return self.set_of(sampler=lambda generator, n: _sample(_rng(), n))


class ShowsTheTask(Sound):
    """Its states and observations take up the goal at the first step."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(-3.0, 3.0, (4,), np.float32)

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return np.pad(super().initial_state(generators), ((0, 0), (0, 2)))

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        return np.concatenate([super().advance(state[:, :2], action, params), params], axis=1)


class ShowsTheRow(Sound):
    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return np.arange(2.0 * len(generators)).reshape(-1, 2) / 100


class EndsAtOnce(Sound):
    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        return np.ones(len(state), dtype=np.bool_)


class SharedGenerator(Sound):
    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return np.random.uniform(-0.1, 0.1, (len(generators), 2))  # noqa: NPY002 - the fault


class LeavesItsSpace(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(-0.001, 0.001, (2,), np.float32)


class LooksAside(Sound):
    """What happens to one sub-environment depends on the others."""

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        moved: Floats = super().advance(state, action, params) + 1e-9 * state.mean(axis=0)
        return moved


class LooksAsideUnseen(Sound):
    """As that, in a column of the state that neither observation nor reward shows."""

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return np.pad(super().initial_state(generators), ((0, 0), (0, 1)))

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        moved = super().advance(state[:, :2], action, params)
        return np.pad(moved, ((0, 0), (0, 1)), constant_values=moved.sum())

    def observe(self, state: Floats) -> NDArray[np.float32]:
        return super().observe(state[:, :2])

    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        state, action, next_state, params = given
        return super().reward(state[:, :2], action, next_state[:, :2], params)


class StartsByChance(Sound):
    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return super().initial_state([_rng() for _ in generators])


class TermsComeAndGo(Sound):
    def reward(self, *given: Floats) -> tuple[Floats, Terms]:
        reward, terms = super().reward(*given)
        return reward, {**terms, **({"late": reward.copy()} if given[0][0, 0] > 0.0 else {})}


class OneBuffer(Sound):
    def __init__(self) -> None:
        super().__init__()
        self._buffers: dict[int, NDArray[np.float32]] = {}

    def observe(self, state: Floats) -> NDArray[np.float32]:
        buffer = self._buffers.setdefault(len(state), np.empty((len(state), 2), np.float32))
        buffer[...] = state
        return buffer


class HasAClock(Sound):
    """All of its kind share a clock, and it is windier the later it is."""

    clock: ClassVar[list[int]] = []

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        self.clock.append(0)
        return super().advance(state, action, params) + 1e-3 * len(self.clock)


class GrowingPicture(Sound):
    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        return super().render(path, params)[len(path) :]


class FloatPicture(Sound):
    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        picture: Any = super().render(path, params) / 255
        return np.asarray(picture)


class BlankPicture(Sound):
    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        return np.zeros((40, 40, 3), np.uint8)
