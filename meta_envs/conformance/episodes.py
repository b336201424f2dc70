"""Checks of the two shells on an environment: what happens from reset to the last step."""

from __future__ import annotations

import copy
import functools
import importlib
import itertools
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from meta_envs.conformance.subject import (
    NonConformityError,
    NotApplicableError,
    Subject,
    require,
    require_same,
)
from meta_envs.headless import RenderingUnavailableError

NUM_ENVS = 7
"""Sub-environments beside each other; no power of two, so that loops over blocks have a rest."""
LIMIT = 15
"""Steps of an episode where a whole one is not needed."""
SHORT = 6
"""Steps of an episode where only its end matters."""
HINTS = ("value is -infinity", "value is infinity")
"""Gymnasium's hints about unbounded observations, which are no fault."""


def passes_gymnasiums_checker(subject: Subject) -> None:
    """Gymnasium's check_env finds nothing."""
    last = len(subject.task_set) - 1
    for task, drawn in ((0, _can_draw(subject)), (last, False)):
        env = subject.make(task=task, render_mode="rgb_array" if drawn else None)
        env.action_space.seed(task)
        _without_warnings(check_env, env.unwrapped, skip_render_check=not drawn)


def passes_stable_baselines3s_checker(subject: Subject) -> None:
    """Stable-Baselines3's check_env finds nothing."""
    try:
        # By name, because the environments must not need it: it is used where it is installed.
        checker = importlib.import_module("stable_baselines3.common.env_checker").check_env
    except ImportError:
        raise NotApplicableError("stable-baselines3 is not installed") from None
    drawable = _can_draw(subject)
    env = subject.make(render_mode="rgb_array" if drawable else None)
    env.action_space.seed(0)
    _without_warnings(checker, env, skip_render_check=not drawable)


@cache
def _can_draw(subject: Subject) -> bool:
    env = subject.make(render_mode="rgb_array")
    env.reset(seed=0)
    try:
        env.render()
    except RenderingUnavailableError:
        return False
    return True


def _without_warnings(checker: Callable[..., Any], *arguments: Any, **kwargs: Any) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker(*arguments, **kwargs)
    messages = [str(warning.message) for warning in caught]
    messages = [one for one in messages if not any(hint in one for hint in HINTS)]
    require(not messages, f"it warns: {'; '.join(messages)}")


def vector_equals_single(subject: Subject, num_envs: int = NUM_ENVS) -> None:
    """Side by side or one by one, on mixed tasks: the same numbers, bit for bit."""
    for mode in AutoresetMode:
        # The modes differ in when they reset, not in how they step.
        limit = LIMIT if mode is AutoresetMode.NEXT_STEP else SHORT
        _compare_shells(subject, mode, num_envs, min(limit, subject.row.horizon))


def _compare_shells(subject: Subject, mode: AutoresetMode, num_envs: int, limit: int) -> None:
    tasks, name = subject.tasks(num_envs), f"in the mode {mode.value}, "
    sync: SyncVectorEnv[Any, Any] = SyncVectorEnv(
        [functools.partial(subject.make, task=task, max_episode_steps=limit) for task in tasks],
        autoreset_mode=mode,
    )
    # Two native threads, because the numbers must not depend on how many there are.
    native = subject.make_vec(tasks=tasks, autoreset_mode=mode, max_episode_steps=limit, threads=2)
    for space in ("observation_space", "action_space", "single_action_space"):
        require(getattr(native, space) == getattr(sync, space), f"{space} differs")
    (obs, info), (its_obs, its_info) = native.reset(seed=3), sync.reset(seed=3)
    require_same(obs, its_obs, f"{name}the first observation differs")
    _compare_infos(info, its_info, name, exact=True)
    _compare_states(native, sync, f"{name}the state at the start differs")
    for step, action in enumerate(subject.actions(2 * limit + 5, num_envs)):
        given = action.copy()
        *mine, info = native.step(action)
        *its, its_info = sync.step(action)
        kinds = ("observation", "reward", "terminated", "truncated")
        for kind, one, other in zip(kinds, mine, its, strict=True):
            require_same(one, other, f"{name}{kind} differs at step {step}")
        _compare_infos(info, its_info, name, exact=mode is not AutoresetMode.SAME_STEP)
        _compare_states(native, sync, f"{name}state differs at step {step}")
        require_same(action, given, f"{name}step writes into the actions it is given")
        # Resetting a third of them midway puts the sub-environments out of step.
        mask = np.zeros(num_envs, dtype=np.bool_)
        mask[::3] = step == limit // 2
        if mode is AutoresetMode.DISABLED:
            mask |= mine[2] | mine[3]
        if mask.any():
            _compare_resets(native, sync, mask, step, name)


def _compare_resets(native: Any, sync: Any, mask: Any, step: int, name: str) -> None:
    seeds = [step if row % 2 else None for row in range(len(mask))]
    obs, info = native.reset(seed=seeds, options={"reset_mask": mask})
    its_obs, its_info = sync.reset(seed=seeds, options={"reset_mask": mask})
    require_same(obs, its_obs, f"{name}the observation after a reset differs")
    require_same(info["task"][mask], its_info["task"][mask], f"{name}the task differs")
    _compare_states(native, sync, f"{name}the state after a reset differs")


def _compare_states(native: Any, sync: Any, otherwise: str) -> None:
    """Of observations, which are rounded and need not show everything, this is the rest."""
    require_same(native.state, np.stack([one.unwrapped.state for one in sync.envs]), otherwise)


def _compare_infos(mine: dict[str, Any], its: dict[str, Any], name: str, exact: bool) -> None:
    """Every entry of SyncVectorEnv's info must be in the native one; with `exact` and no other."""
    for key in (key for key in its if not key.startswith("_")):
        require(key in mine, f"{name}info lacks '{key}'")
        mask, held = mine[f"_{key}"], its[f"_{key}"]
        require((mask == held if exact else mask | ~held).all(), f"{name}mask '_{key}' differs")
        if key == "final_info":
            _compare_infos(mine[key], its[key], name, exact=True)
        elif key == "final_obs":
            require_same(mine[key][held], np.stack(its[key][held]), f"{name}{key} differs")
        else:
            require_same(mine[key][held], its[key][held], f"{name}info['{key}'] differs")
    if exact:
        for key in (key for key in mine if not key.startswith("_") and key not in its):
            require(not mine[f"_{key}"].any(), f"{name}info has '{key}' too")


def seed_decides_everything(subject: Subject) -> None:
    """The same seed gives the same episode, whatever other environments do meanwhile."""
    alone, disturbed = _trace(subject, disturb=False), _trace(subject, disturb=True)
    for step, (one, other) in enumerate(zip(alone, disturbed, strict=True)):
        require_same(one, other, f"two runs from the same seed differ at entry {step}")


def _trace(subject: Subject, disturb: bool) -> list[Any]:
    tasks = subject.tasks(3)
    env, vector = subject.make(task=tasks[1]), subject.make_vec(tasks=tasks[:2])
    actions = subject.actions(12, 2)
    env.reset(seed=9)
    env.step(actions[0, 0])
    found = [env.reset(seed=3)[0], vector.reset(seed=[3, 4])[0]]
    found += [vector.reset(seed=3)[0]]
    require_same(found[1], found[2], "seed=3 is not seed=[3, 4] for two sub-environments")
    env.action_space.seed(11)
    vector.action_space.seed(12)
    vector.single_action_space.seed(13)
    if disturb:
        other, others = subject.make(task=tasks[0]), subject.make_vec(tasks=tasks)
        for one in (other, others):
            one.reset(seed=9)
            one.action_space.seed(0)
            one.observation_space.seed(0)
            one.step(one.action_space.sample())
        others.single_action_space.seed(0)
    for action in actions:
        found += [env.action_space.sample(), vector.single_action_space.sample()]
        obs, reward, terminated, truncated, _ = env.step(action[0])
        found += [obs, reward, terminated, truncated, *vector.step(action)[:4]]
        if terminated or truncated:
            found.append(env.reset()[0])
    return found


def info_is_constant(subject: Subject) -> None:
    """`info` has the same keys and types at every step, the task among them."""
    env, vector = subject.make(), subject.make_vec(num_envs=3)
    for one, expected in ((env, {"task"}), (vector, {"task", "_task"})):
        keys = set(one.reset(seed=0)[1])
        require(keys == expected, f"the info of a reset has {sorted(keys)}, not just the task")
    single_kinds: dict[str, type] = {}
    for action in subject.actions(2 * min(subject.row.horizon, LIMIT) + 3, 3):
        _, reward, terminated, truncated, info = env.step(action[0])
        types = (type(reward), type(terminated), type(truncated))
        require(types == (float, bool, bool), f"a step's types are {types}")
        kinds = {key: type(value) for key, value in info.items()}
        single_kinds = single_kinds or kinds
        require(kinds == single_kinds, f"info was {single_kinds} and becomes {kinds}")
        require(kinds.get("task") is int, "info has no integer 'task'")
        if terminated or truncated:
            env.reset()
        vector_kinds: dict[str, Any] = {key: np.dtype(kind) for key, kind in single_kinds.items()}
        vector_kinds |= {f"_{key}": np.dtype(bool) for key in single_kinds}
        info = vector.step(action)[4]
        found = {key: value.dtype for key, value in info.items()}
        require(found == vector_kinds, f"info side by side is {found}, one by one {kinds}")
        require(all(value.shape == (3,) for value in info.values()), "info has another shape")


def only_the_horizon_truncates(subject: Subject) -> None:
    """An episode that does not end before is truncated at the horizon, and none elsewhere."""
    horizon = subject.row.horizon
    for steps in {min(3, horizon), horizon}:
        kwargs = {} if steps == horizon else {"max_episode_steps": steps}
        env, vector = subject.make(**kwargs), subject.make_vec(num_envs=2, **kwargs)
        require(vector.horizon == steps, f"side by side the time limit is {vector.horizon}")
        env.reset(seed=0)
        vector.reset(seed=0)
        age, ages = 0, np.zeros(2, dtype=np.int64)
        for action in subject.actions(min(3 * steps, horizon + 5), 2):
            age, ages = age + 1, ages + 1
            terminated, truncated = env.step(action[0])[2:4]
            wrong = truncated is not (age == steps)
            require(not wrong, f"truncated is {truncated} at step {age} of at most {steps}")
            over, out_of_time = vector.step(action)[2:4]
            # Zero is the step that resets, at which nothing is truncated.
            require_same(out_of_time, ages == steps, "side by side, truncated is wrong")
            ages[over | out_of_time] = -1
            if terminated or truncated:
                env.reset()
                age = 0


def spaces_hold(subject: Subject) -> None:
    """Every observation is in its space, for actions at random and at the bounds."""
    tasks = subject.tasks(2)
    env, made = subject.make_vec(tasks=tasks), subject.definition
    size = made.action_space.shape[0]
    shape = (min(subject.row.horizon, 2 * LIMIT), len(tasks), size)
    at_random = subject.actions(subject.row.horizon, len(tasks))
    for actions in (at_random, np.full(shape, -1.0), np.full(shape, 1.0)):
        _require_inside(env.observation_space, env.reset(seed=1)[0], 0)
        for step, action in enumerate(actions, start=1):
            _require_inside(env.observation_space, env.step(action)[0], step)


def _require_inside(space: Any, obs: Any, step: int) -> None:
    if not space.contains(obs):
        where = np.argwhere(~((obs >= space.low) & (obs <= space.high)))
        value = obs[tuple(where[0])] if len(where) else obs.dtype
        raise NonConformityError(f"observation {value} at step {step} is not in its space")


def nonsense_is_refused(subject: Subject) -> None:
    """Wrong actions, tasks and options are a ValueError and change nothing."""
    size, n_tasks = subject.definition.action_space.shape[0], len(subject.task_set)
    twin, env = subject.make(), subject.make()
    vector, vector_twin = subject.make_vec(num_envs=2), subject.make_vec(num_envs=2)
    for one in (twin, env, vector, vector_twin):
        one.reset(seed=4)
    nan, nans = np.zeros(size), np.zeros((2, size))
    nan[-1] = nans[1, 0] = np.nan
    wrong: dict[str, Callable[[], Any]] = {
        "an action of NaN": lambda: env.step(nan),
        "an action of another size": lambda: env.step(np.zeros(size + 1)),
        "a task too many": lambda: env.reset(options={"task": n_tasks}),
        "a negative task": lambda: env.reset(options={"task": -1}),
        "half a task": lambda: env.reset(options={"task": 0.5}),
        "an unknown option": lambda: env.reset(options={"tsak": 0}),
        "a task too many, at the start": lambda: subject.make(task=n_tasks),
        "actions of NaN": lambda: vector.step(nans),
        "too few actions": lambda: vector.step(np.zeros((1, size))),
        "tasks too many": lambda: vector.reset(options={"task": [0, n_tasks]}),
    }
    for name, call in wrong.items():
        try:
            call()
        except ValueError:
            continue
        raise NonConformityError(f"{name} is accepted")
    still = np.zeros((2, size), dtype=np.float32)
    require_same(env.step(still[0])[0], twin.step(still[0])[0], "what it refuses changes it")
    after = vector.step(still)[0], vector_twin.step(still)[0]
    require_same(*after, "side by side, what it refuses changes it")


def arrays_are_fresh(subject: Subject) -> None:
    """What a caller writes into the arrays it was given does not matter."""
    for mode in AutoresetMode:
        kwargs = {"num_envs": 2, "autoreset_mode": mode, "max_episode_steps": 3}
        env, twin = subject.make_vec(**kwargs), subject.make_vec(**kwargs)
        seen = _arrays_in(env.reset(seed=0))
        twin.reset(seed=0)
        for action in subject.actions(8, 2):
            result, expected = env.step(action), twin.step(action)
            fresh = _arrays_in(result)
            for one, other in zip(fresh, _arrays_in(expected), strict=True):
                require_same(one, other, "what a caller writes into returned arrays matters")
            inner = [value for value in vars(env).values() if isinstance(value, np.ndarray)]
            seen += fresh
            for one, other in itertools.combinations([*fresh, *inner], 2):
                shared = np.shares_memory(one, other) and not (
                    any(one is mine for mine in inner) and any(other is mine for mine in inner)
                )
                require(not shared, "two returned arrays share memory, or one with the environment")
            for array in seen:
                array[...] = 1
            if mode is AutoresetMode.DISABLED and (expected[2] | expected[3]).any():
                seen += _arrays_in(env.reset(seed=1))
                twin.reset(seed=1)


def _arrays_in(result: Any) -> list[Any]:
    if isinstance(result, dict):
        return [array for value in result.values() for array in _arrays_in(value)]
    if isinstance(result, tuple):
        return [array for value in result for array in _arrays_in(value)]
    return [result]


def specs_rebuild_it(subject: Subject) -> None:
    """The environment's spec, written as JSON and read again, makes the same environment."""
    tasks = subject.tasks(2)
    env = subject.make(task=tasks[1])
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    require(again.unwrapped.task == tasks[1], "the single environment has another task")
    require(again.unwrapped.definition is env.unwrapped.definition, "it is another one")
    vector = subject.make_vec(tasks=tasks, autoreset_mode="SameStep")
    rebuilt: Any = gymnasium.make_vec(EnvSpec.from_json(vector.spec.to_json()))
    require(type(rebuilt) is type(vector), f"side by side it is a {type(rebuilt).__name__}")
    require(rebuilt.tasks.tolist() == tasks, "side by side it has other tasks")
    require(rebuilt.autoreset_mode is AutoresetMode.SAME_STEP, "its autoreset mode is another")
    require(rebuilt.horizon == subject.row.horizon, "its time limit is another")


def copies_go_their_own_way(subject: Subject) -> None:
    """A deep copy goes on as the original would, and neither disturbs the other."""
    env, actions = subject.make(), subject.actions(6, 1)[:, 0]
    env.reset(seed=2)
    env.step(actions[1])
    try:
        copied = copy.deepcopy(env)
    except TypeError as error:
        raise NotApplicableError(f"it cannot be copied: {error}") from None
    again = subject.make()
    again.reset(seed=2)
    again.step(actions[1])
    for one, name in ((copied, "a copy goes on otherwise"), (env, "a copy's steps matter")):
        twin = copy.deepcopy(again)
        for action in actions[2:]:
            step, expected = one.step(action), twin.step(action)
            require_same(step[0], expected[0], name)
            if step[2] or step[3]:
                break


def pictures_are_arrays(subject: Subject) -> None:
    """Both shells draw the same pictures, arrays of uint8, all of one size."""
    tasks = subject.tasks(2)
    env = subject.make(task=tasks[0], render_mode="rgb_array")
    vector = subject.make_vec(tasks=tasks, render_mode="rgb_array")
    env.reset(seed=0)
    vector.reset(seed=[0, 0])
    try:
        picture, pictures = env.render(), vector.render()
    except RenderingUnavailableError as error:
        raise NotApplicableError(str(error)) from None
    _check_picture(picture)
    require(type(pictures) is tuple and len(pictures) == 2, "side by side there is no tuple")
    require_same(pictures[0], picture, "side by side the picture is another")
    env.step(np.full(subject.definition.action_space.shape, 0.5, dtype=np.float32))
    later = env.render()
    _check_picture(later)
    sizes = sorted({picture.shape, pictures[1].shape, later.shape})
    require(len(sizes) == 1, f"pictures have several sizes: {sizes}")


def _check_picture(picture: Any) -> None:
    right = picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    require(right, f"a picture is {picture.dtype} {list(picture.shape)}")
    require(picture.min() != picture.max(), "a picture is of one colour")
