"""Checks of a Definition and of its tasks."""

from __future__ import annotations

import importlib
import itertools
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.conformance.subject import NotApplicableError, Subject, require, require_same
from meta_envs.definition import Definition
from meta_envs.tasks import Split, TaskSet

RESERVED = ("task", "final_obs", "final_info", "episode", "reset_mask")
"""Keys of `info` that are not for a reward's terms."""
ROWS = 3
HIDDEN_ROWS, HIDDEN_STEPS = 11, 20
LEAST_STEPS = 3


def definition_is_complete(subject: Subject) -> None:
    """The Definition can be made, bears its own name and declares its spaces."""
    made = subject.definition
    require(isinstance(made, Definition), "it is not a Definition")
    require(made.name == subject.row.name, f"it calls itself '{made.name}'")
    require(made.horizon == subject.row.horizon, f"its horizon is {made.horizon}")
    require(made.horizon >= 1, f"its horizon is {made.horizon}, at least 1 is needed")
    for name in ("observation_space", "action_space"):
        space: Any = getattr(made, name, None)
        require(isinstance(space, Box), f"its {name} is {space!r}, not a Box")
        flat = len(space.shape) == 1 and space.dtype == np.float32
        require(flat, f"its {name} is not a float32 Box of one dimension: {space}")
    unit = (made.action_space.low == -1.0).all() and (made.action_space.high == 1.0).all()
    require(unit, f"its actions are not from -1 to 1: {made.action_space}")


def _generators(seed: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed + row) for row in range(ROWS)]


def functions_are_batched(subject: Subject) -> None:
    """Its functions return the documented shapes and types and leave their arguments alone."""
    made, params = subject.definition, subject.task_set.params[subject.tasks(ROWS)]
    action = np.clip(subject.actions(2, ROWS)[1], -1.0, 1.0).astype(np.float64)
    state = made.initial_state(_generators(0))
    _require_array("initial_state", state, np.float64, (ROWS, *state.shape[1:]))
    require(state.ndim == 2, f"initial_state has the shape {state.shape}, not [n, S]")
    again = made.initial_state(_generators(0))
    require_same(state, again, "initial_state differs for generators of the same seed")
    simulation = made.simulation(ROWS)
    simulation.set_params(params)
    given = [array.copy() for array in (state, action, params)]
    next_state = simulation.step(state, action)
    _require_array("the next state", next_state, np.float64, state.shape)
    obs = made.observe(next_state)
    _require_array("observe", obs, np.float32, (ROWS, *made.observation_space.shape))
    reward, terms = made.reward(state, action, next_state, params)
    _require_array("reward", reward, np.float64, (ROWS,))
    _require_array("terminated", made.terminated(next_state), np.bool_, (ROWS,))
    for array, before, name in zip(
        (state, action, params), given, ("states", "actions", "params"), strict=True
    ):
        require_same(array, before, f"it writes into the {name} it is given")
    arrays: dict[str, NDArray[Any]] = {
        "next state": next_state,
        "observation": obs,
        "reward": reward,
        **terms,
    }
    for (one, first), (other, second) in itertools.combinations(arrays.items(), 2):
        require(not np.shares_memory(first, second), f"{one} and {other} share memory")
    for name, array in arrays.items():
        require(array.flags.writeable, f"{name} is read-only, but the caller may write to it")
        require(not np.shares_memory(array, state), f"{name} shares memory with the states")


def _require_array(name: str, found: Any, dtype: Any, shape: tuple[int, ...]) -> None:
    require(isinstance(found, np.ndarray), f"{name} gives {type(found).__name__}, not an array")
    expected = f"{np.dtype(dtype)} {list(shape)}"
    right = found.dtype == np.dtype(dtype) and found.shape == shape
    require(right, f"{name} gives {found.dtype} {list(found.shape)} instead of {expected}")


def reward_terms_add_up(subject: Subject) -> None:
    """The reward's terms are finite numbers or flags; those called reward_... add up to it."""
    made, rows = subject.definition, len(subject.tasks(ROWS))
    env = subject.make_vec(tasks=subject.tasks(ROWS), autoreset_mode="SameStep")
    env.reset(seed=0)
    simulation = made.simulation(rows)
    simulation.set_params(env.params)
    for action in subject.actions(min(made.horizon, 40), rows):
        state = env.state.copy()
        clipped = np.clip(action, -1.0, 1.0).astype(np.float64)
        next_state = simulation.step(state, clipped)
        reward, terms = made.reward(state, clipped, next_state, env.params)
        _check_terms(made, reward, terms)
        env.step(action)


def _check_terms(made: Definition, reward: NDArray[np.float64], terms: dict[str, Any]) -> None:
    require(np.isfinite(reward).all(), f"a reward is not finite: {reward}")
    for name, values in terms.items():
        free = name not in RESERVED and not name.startswith("_")
        require(free, f"no term may be called '{name}'")
        right = values.shape == reward.shape and values.dtype in (np.float64, np.bool_)
        require(right, f"term '{name}' is {values.dtype} {list(values.shape)}")
        require(np.isfinite(values).all(), f"term '{name}' is not finite: {values}")
    if "is_success" in terms:
        require(terms["is_success"].dtype == np.bool_, "term 'is_success' is not bool")
    if made.sparse:
        require("dense_reward" in terms, "it is sparse, but has no term 'dense_reward'")
    parts = [values for name, values in terms.items() if name.startswith("reward_")]
    if parts:
        close = np.allclose(sum(parts), reward, rtol=1e-9, atol=1e-9)
        require(close, f"its terms reward_... add up to {sum(parts)}, the reward is {reward}")


def tasks_are_fixed(subject: Subject) -> None:
    """Its tasks are the same whenever they are made, and no two of them are alike."""
    tasks = subject.task_set
    require(tasks.env == subject.row.name, f"its tasks say they are of '{tasks.env}'")
    again = _made_anew(subject).tasks()
    require(again.hash == tasks.hash, "another instance has other tasks")
    require_same(again.params, tasks.params, "another instance has other tasks")
    distinct = len(np.unique(tasks.params, axis=0))
    require(distinct == len(tasks), f"of its {len(tasks)} tasks only {distinct} differ")


def _made_anew(subject: Subject) -> Definition:
    module, _, attribute = subject.row.definition.partition(":")
    made: Definition = getattr(importlib.import_module(module), attribute)()
    return made


def splits_are_sound(subject: Subject) -> None:
    """In each split, training and test tasks are apart, or the same where that is all there is."""
    tasks = subject.task_set
    for name, split in tasks.splits.items():
        for kind in ("train_tasks", "test_tasks"):
            require(len(getattr(split, kind)) > 0, f"split '{name}' has no {kind}")
        both = np.intersect1d(split.train_tasks, split.test_tasks)
        same = np.array_equal(split.train_tasks, split.test_tasks)
        require(
            not both.size or same,
            f"tasks {both.tolist()} of split '{name}' are for training and for the test",
        )
    if "extrapolate" in tasks.splits:
        _check_extrapolation(tasks, tasks.splits["extrapolate"])


def _check_extrapolation(tasks: TaskSet, split: Split) -> None:
    train, test = tasks.params[split.train_tasks], tasks.params[split.test_tasks]
    outside = ((test < train.min(axis=0)) | (test > train.max(axis=0))).any(axis=1)
    within = split.test_tasks[~outside].tolist()
    require(not within, f"test tasks {within} of 'extrapolate' are within the training range")


def sampler_gives_tasks(subject: Subject) -> None:
    """Fresh tasks depend on the seed alone, and an environment runs on them."""
    tasks = subject.task_set
    fresh = tasks.sample(seed=0, n_tasks=50)
    require_same(
        fresh.params, tasks.sample(seed=0, n_tasks=50).params, "one seed gives two samples"
    )
    differ = (fresh.params != tasks.sample(seed=1, n_tasks=50).params).any()
    require(differ, "two seeds give the same sample")
    env = subject.make_vec(tasks=range(5), task_set=fresh)
    env.reset(seed=0)
    for action in subject.actions(5, 5):
        obs, reward, *_ = env.step(action)
        finite = np.isfinite(obs).all() and np.isfinite(reward).all()
        require(finite, "on fresh tasks an observation or a reward is not finite")


def own_params_make_the_task(subject: Subject) -> None:
    """A task made from its parameters' values is that task, bit for bit."""
    tasks, task = subject.task_set, len(subject.task_set) - 1
    values = dict(zip(tasks.param_names, tasks.params[task].tolist(), strict=True))
    one, other = subject.make(task=task), subject.make(task_params=values)
    require_same(one.reset(seed=3)[0], other.reset(seed=3)[0], "the first observation differs")
    for action in subject.actions(min(subject.row.horizon, 20), 1)[:, 0]:
        step, its_step = one.step(action), other.step(action)
        for name, mine, its in zip(("observation", "reward"), step[:2], its_step[:2], strict=True):
            require_same(mine, its, f"the {name} differs")
        if step[2] or step[3]:
            break


def task_is_hidden(subject: Subject) -> None:
    """The observation does not hold the task."""
    rows = subject.tasks(HIDDEN_ROWS)
    env = subject.make_vec(tasks=rows)
    seen = [env.reset(seed=[5] * len(rows))[0]]
    different = np.flatnonzero((seen[0] != seen[0][0]).any(axis=0)).tolist()
    require(
        not different,
        f"components {different} of the first observation differ from task to task, although the "
        "seed is the same",
    )
    # The same actions for all, so that nothing but the task can make a difference.
    for action in subject.actions(min(subject.row.horizon, HIDDEN_STEPS), 1):
        obs, _, terminated, truncated, _ = env.step(np.repeat(action, len(rows), axis=0))
        if (terminated | truncated).any():
            break
        seen.append(obs)
    later = np.array(seen[1:])
    if len(later) < LEAST_STEPS:
        raise NotApplicableError("episodes are too short to tell")
    constant = (later == later[0]).all(axis=(0, 1))
    telling = np.flatnonzero(constant & (later[0] != later[0][0]).any(axis=0)).tolist()
    require(
        not telling,
        f"components {telling} of the observation stay as they are during an episode and differ "
        "from task to task",
    )


def _shared_states() -> tuple[Any, ...]:
    numpys: Any = np.random.get_state()  # noqa: NPY002 - only looked at
    return (
        random.getstate(),
        *(getattr(part, "tolist", lambda part=part: part)() for part in numpys),
    )


@contextmanager
def no_shared_generator() -> Iterator[None]:
    """Raise a NonConformityError if a generator that everyone shares is drawn from or seeded."""
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002 - put back below
    # A state no code would set, for else one that seeds it again and again would go unseen.
    random.seed(918273645)
    np.random.seed(918273645)  # noqa: NPY002 - the shared generator is the one that is checked
    before = _shared_states()
    try:
        yield
        require(_shared_states() == before, "it draws from, or seeds, a generator everyone shares")
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002 - as it was


def shared_generators_are_left_alone(subject: Subject) -> None:
    """It neither draws from nor seeds the generators of `random` and `numpy.random`."""
    with no_shared_generator():
        made, tasks = _made_anew(subject), subject.task_set
        made.tasks()
        tasks.sample(seed=0, n_tasks=5)
        single = subject.make(task=len(tasks) - 1)
        vector = subject.make_vec(tasks=subject.tasks(ROWS))
        single.reset(seed=3)
        single.reset(options={"task": 0})
        vector.reset(seed=3)
        single.action_space.seed(1)
        single.action_space.sample()
        for action in subject.actions(10, ROWS):
            if any(single.step(action[0])[2:4]):
                single.reset()
            vector.step(action)
