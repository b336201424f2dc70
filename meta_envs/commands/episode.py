"""An episode in pictures: the exact optimum's where it is known, else one of random actions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from meta_envs.env import MetaVectorEnv
from meta_envs.registry import Row, definition


def who_acts(row: Row, seed: int) -> str:
    """Whose episode it is, a few words."""
    known = "oracle" in definition(row.name).controllers
    return "the optimum's episode" if known else f"an episode of random actions (seed {seed})"


def pictures(
    row: Row, task: int, seed: int = 0, every: int | None = None, steps: int | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Pictures [height, width, 3] of one episode.

    Args:
        row: the environment.
        task: row of its task set.
        seed: of the episode's start and of random actions.
        every: steps from one picture to the next, the first and the last state always among them;
            None is the last alone.
        steps: stop after so many, if the episode is not over before.
    """
    env = MetaVectorEnv(
        row.name, tasks=[task], autoreset_mode="Disabled", render_mode="rgb_array", threads=1
    )
    oracle = env.definition.controllers.get("oracle")
    generator, shape = np.random.default_rng(seed), env.action_space.shape
    env.reset(seed=seed)
    step, over = 0, False
    while not over:
        if every is not None and step % every == 0:
            yield _picture(env)
        if oracle is None:
            action = generator.uniform(-1.0, 1.0, shape)
        else:
            action = oracle(env.state, env.params)
        _, _, terminated, truncated, _ = env.step(action)
        step += 1
        over = bool(terminated[0] or truncated[0]) or step == steps
    yield _picture(env)


def _picture(env: MetaVectorEnv) -> NDArray[np.uint8]:
    found = env.render()
    assert found is not None
    return found[0]
