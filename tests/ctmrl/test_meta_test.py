"""The meta-test against one written from its description, environment by environment."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.data import OfflineData
from ctmrl.meta_test import Group, MetaTest, MetaTestConfig, MetaTestResult, meta_test
from ctmrl.networks import Actor, ContextEncoder
from meta_envs import ENVIRONMENTS, MetaEnv, TaskSet, task_set

CONFIG = MetaTestConfig(random_episodes=2, policy_episodes=3, scored_episodes=1, repetitions=2)
ROWS = np.array([4, 0, 7])
SEED, Z = 5, 7


class CountingEncoder(ContextEncoder):
    """An encoder that keeps what it is given, [num_envs, F] at a time."""

    def __init__(self) -> None:
        ones = torch.ones(7)
        super().__init__((0.1 * ones, 0.5 * ones), 2, (11,), Z)
        self.given: list[Tensor] = []

    def forward(self, context: Tensor) -> Tensor:
        self.given.append(context.clone())
        return super().forward(context)


@pytest.fixture
def encoder() -> CountingEncoder:
    return CountingEncoder()


@pytest.fixture
def actor() -> Actor:
    made = Actor((torch.zeros(2), torch.ones(2)), Z, (13,), 2)
    with torch.no_grad():
        # Far apart for different contexts, so that every context matters.
        next(made.parameters()).mul_(3.0)
        # And to the right, over the edge where the noisy robot's episodes end.
        list(made.parameters())[-1][0] += 0.3
    return made


class Adaptation:
    """The protocol for single environments; it draws as the batched one says it does."""

    def __init__(self, encoder: ContextEncoder, actor: Actor, tasks: TaskSet, rows: list[int]):
        self.encoder, self.actor = encoder, actor
        self.envs = [MetaEnv(tasks.env, task, task_set=tasks) for task in rows]
        self.horizon = ENVIRONMENTS[tasks.env].horizon
        self.noise = np.random.default_rng(SEED)
        self.generator = torch.Generator().manual_seed(SEED)
        self.transitions: list[list[Tensor]] = [[] for _ in rows]
        self.scored_steps = [0] * len(rows)
        for number, env in enumerate(self.envs):
            env.reset(seed=SEED + number)

    def contexts(self) -> Tensor:
        """The mean over everything each environment has explored, 0 before that."""
        rows = [
            self.encoder(torch.stack(seen)).mean(dim=0) if seen else torch.zeros(Z)
            for seen in self.transitions
        ]
        return torch.stack(rows)

    def actions(self, kind: str, obs: Tensor, z: Tensor) -> NDArray[np.float32]:
        n = len(self.envs)
        if kind == "random":
            return self.noise.uniform(-1, 1, (n, 2)).astype(np.float32)
        mean, log_std = self.actor(obs, z)
        if kind == "policy":
            mean = mean + log_std.exp() * torch.randn(n, 2, generator=self.generator)
        found: NDArray[np.float32] = torch.tanh(mean).numpy()
        return found

    def episode(self, kind: str) -> list[float]:
        """One episode in every environment; an environment that is over starts another, unused."""
        z = self.contexts()
        obs = [env.reset()[0] for env in self.envs]
        n = len(self.envs)
        returns, running, over, age = [0.0] * n, [True] * n, [False] * n, [0] * n
        while any(running):
            action = self.actions(kind, torch.from_numpy(np.stack(obs)), z)
            for k, env in enumerate(self.envs):
                if over[k]:
                    obs[k], over[k], age[k] = env.reset()[0], False, 0
                    continue
                after, reward, terminated, _, _ = env.step(action[k])
                age[k] += 1
                if running[k]:
                    returns[k] += reward
                    self.scored_steps[k] += kind == "score"
                    if kind != "score":
                        row = np.concatenate([obs[k], action[k], [np.float32(reward)], after])
                        self.transitions[k].append(torch.from_numpy(row).float())
                over[k] = terminated or age[k] == self.horizon
                running[k] = running[k] and not over[k]
                obs[k] = after
        return returns


@torch.no_grad()
def by_single_environments(
    encoder: ContextEncoder,
    actor: Actor,
    tasks: TaskSet,
    config: MetaTestConfig,
    online: bool = False,
) -> tuple[MetaTestResult, list[int], list[int]]:
    """The result, and how many steps each environment explored and was scored."""
    rows = [int(task) for _ in range(config.repetitions) for task in ROWS]
    run = Adaptation(encoder, actor, tasks, rows)
    kinds = ["random"] * config.random_episodes + ["policy"] * config.policy_episodes
    curve = []
    for kind in kinds:
        if online:
            curve.append(run.episode("read and scored"))
            continue
        curve.append(run.episode("score"))
        run.episode(kind)
    scored = [run.episode("score") for _ in range(config.scored_episodes)]
    final = np.mean(scored, axis=0)
    shape = (config.repetitions, len(ROWS))
    result = MetaTestResult(
        final.reshape(shape),
        np.array([*curve, final]).reshape(-1, *shape).mean(axis=1),
        run.contexts().reshape(*shape, Z).numpy(),
    )
    return result, [len(seen) for seen in run.transitions], run.scored_steps


@pytest.fixture(params=["point_robot_wind", "sparse_point_robot", "noisy_robot"])
def tasks(request: pytest.FixtureRequest) -> TaskSet:
    """Task sets; the noisy robot's episodes start anywhere and end early."""
    if request.param == "noisy_robot":
        request.getfixturevalue("noisy_robot")
    return task_set(request.param)


@pytest.mark.parametrize(
    "change",
    [{}, {"repetitions": 1, "scored_episodes": 3}, {"random_episodes": 0}, {"policy_episodes": 0}],
    ids=str,
)
def test_the_protocol(
    tasks: TaskSet, change: dict[str, int], encoder: CountingEncoder, actor: Actor
) -> None:
    config = dataclasses.replace(CONFIG, **change)
    found = meta_test(encoder, actor, tasks, ROWS, config, SEED)
    wanted, counts, scored = by_single_environments(encoder, actor, tasks, config)
    episodes = config.random_episodes + config.policy_episodes
    assert found.returns.shape == (config.repetitions, 3)
    assert found.curve.shape == (episodes + 1, 3)
    np.testing.assert_allclose(found.returns, wanted.returns, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.curve, wanted.curve, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.contexts, wanted.contexts, rtol=1e-4, atol=1e-5)
    # Exploration moved the contexts, and contexts moved the returns.
    assert np.abs(found.contexts).max(axis=-1).min() > 1e-3
    assert len({round(value, 4) for value in found.curve[:, 0]}) > 1 or tasks.env.startswith("spa")
    if tasks.env == "noisy_robot":
        # Some are over while others still run.
        assert change or len(set(counts)) > 1
        assert len(set(scored)) > 1
    else:
        assert set(counts) == {episodes * ENVIRONMENTS[tasks.env].horizon}


@pytest.mark.parametrize("change", [{}, {"repetitions": 1, "scored_episodes": 3}], ids=str)
def test_online_explores_with_the_deterministic_policy_from_the_start(
    tasks: TaskSet, change: dict[str, int], encoder: CountingEncoder, actor: Actor
) -> None:
    config = dataclasses.replace(CONFIG, **change)
    test = MetaTest(encoder, actor, tasks, config, SEED)
    found = test.run({"some": Group(ROWS, "online")})["some"]
    wanted, _, _ = by_single_environments(encoder, actor, tasks, config, online=True)
    assert found.curve.shape == (6, 3)
    np.testing.assert_allclose(found.returns, wanted.returns, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.curve, wanted.curve, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.contexts, wanted.contexts, rtol=1e-4, atol=1e-5)
    # Its first episode is on no context; what it scores at last is not read.
    none = dataclasses.replace(config, random_episodes=0, policy_episodes=0, scored_episodes=1)
    without = meta_test(encoder, actor, tasks, ROWS, none, SEED)
    np.testing.assert_array_equal(found.curve[0], without.curve[0])


@pytest.mark.parametrize("group", [Group(ROWS, "offline"), Group(ROWS, "online", torch.zeros(1))])
def test_a_group_with_data_that_do_not_fit_its_protocol(
    group: Group, encoder: CountingEncoder, actor: Actor
) -> None:
    test = MetaTest(encoder, actor, task_set("point_robot_wind"), CONFIG, SEED)
    with pytest.raises(ValueError, match="group 'some': offline contexts need data, no others"):
        test.run({"some": group})


def test_contexts_are_of_all_explored_transitions_random_ones_first(
    encoder: CountingEncoder, actor: Actor
) -> None:
    tasks = task_set("point_robot_wind")
    meta_test(encoder, actor, tasks, ROWS, CONFIG, SEED)
    given = torch.stack(encoder.given)
    # (2 + 3) episodes of 25 steps in 2 x 3 environments: the six scored episodes are not there.
    assert given.shape == (5 * 25, 6, 7)
    noise = np.random.default_rng(SEED)
    for step in range(50):
        wanted = noise.uniform(-1, 1, (6, 2)).astype(np.float32)
        assert given[step, :, 2:4].numpy().tolist() == wanted.tolist()
    # All of an episode's actions come from the context before it, fixed.
    draw = torch.Generator().manual_seed(SEED)
    for episode in (2, 3, 4):
        with torch.no_grad():
            z = ContextEncoder.forward(encoder, given[: 25 * episode]).mean(dim=0)
            for step in range(25 * episode, 25 * episode + 25):
                action = actor.sample(given[step, :, :2], z, draw).action
                torch.testing.assert_close(given[step, :, 2:4], action, rtol=1e-4, atol=1e-5)
    # Each episode starts at the origin and each row follows the one before.
    starts = torch.arange(0, 125, 25)
    assert not given[starts, :, :2].any()
    inside = torch.ones(124, dtype=torch.bool)
    inside[starts[1:] - 1] = False
    assert given[1:][inside][..., :2].equal(given[:-1][inside][..., 5:])


@pytest.mark.parametrize("dense", [False, True])
def test_contexts_see_the_sparse_reward_unless_asked_otherwise(
    encoder: CountingEncoder, actor: Actor, dense: bool
) -> None:
    tasks = task_set("sparse_point_robot")
    encoder.sees_dense_reward = dense
    result = meta_test(encoder, actor, tasks, ROWS, CONFIG, SEED)
    assert (result.returns >= 0).all()
    given = torch.stack(encoder.given)
    goals = torch.from_numpy(np.tile(tasks.params[ROWS], (2, 1))).float()
    distance = (given[..., 5:] - goals).norm(dim=-1)
    wanted = -distance if dense else (1 - distance / 0.2).clamp_min(0)
    torch.testing.assert_close(given[..., 4], wanted, atol=1e-5, rtol=0)


def test_without_exploration_the_context_is_0(encoder: CountingEncoder, actor: Actor) -> None:
    tasks = task_set("point_robot_wind")
    none = dataclasses.replace(CONFIG, random_episodes=0, policy_episodes=0)
    found = meta_test(encoder, actor, tasks, ROWS, none, SEED)
    assert not found.contexts.any()
    assert not encoder.given
    np.testing.assert_allclose(found.curve, found.returns.mean(axis=0)[None])


def test_scored_episodes_are_deterministic(encoder: CountingEncoder, actor: Actor) -> None:
    tasks = task_set("point_robot_wind")
    once, thrice = (
        meta_test(encoder, actor, tasks, ROWS, dataclasses.replace(CONFIG, scored_episodes=n), SEED)
        for n in (1, 3)
    )
    np.testing.assert_allclose(once.returns, thrice.returns, rtol=1e-12)
    np.testing.assert_array_equal(once.contexts, thrice.contexts)


def test_the_same_seed_gives_the_same_and_repetitions_differ(
    encoder: CountingEncoder, actor: Actor
) -> None:
    tasks = task_set("point_robot_wind")
    first, again, other = (
        meta_test(encoder, actor, tasks, ROWS, CONFIG, seed) for seed in (5, 5, 6)
    )
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert (first.contexts != other.contexts).any(axis=-1).all()
    assert (first.contexts[0] != first.contexts[1]).any(axis=-1).all()


def test_nothing_is_learnt_and_no_shared_generator_is_touched(
    encoder: CountingEncoder, actor: Actor, wind_data: OfflineData
) -> None:
    before = torch.random.get_rng_state()
    weights = [parameter.clone() for parameter in (*encoder.parameters(), *actor.parameters())]
    found = meta_test(encoder, actor, task_set("point_robot_wind"), wind_data.tasks, CONFIG, 0)
    assert found.returns.shape == (2, 7)
    assert torch.random.get_rng_state().equal(before)
    for parameter, weight in zip(
        (*encoder.parameters(), *actor.parameters()), weights, strict=True
    ):
        assert parameter.equal(weight)
        assert parameter.grad is None


def networks(env: str) -> tuple[ContextEncoder, Actor]:
    """Networks for an environment, so small that the batch they are given shows in last bits."""
    alone = MetaEnv(env)
    (obs,), (act,) = alone.observation_space.shape or (), alone.action_space.shape or ()
    ones = torch.ones(2 * obs + act + 1)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        encoder = ContextEncoder((0.1 * ones, 0.5 * ones), obs, (11,), Z)
        actor = Actor((torch.zeros(obs), torch.ones(obs)), Z, (13,), act)
    with torch.no_grad():
        # Over the edge where the noisy robot's episodes end.
        [*actor.parameters()][-1][0] += 0.5
    return encoder, actor


def same(one: MetaTestResult, other: MetaTestResult) -> bool:
    return all(
        np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in zip(one, other, strict=True)
    )


def counted(test: MetaTest, groups: dict[str, Group]) -> tuple[dict[str, MetaTestResult], int]:
    """The results, and how many steps they took."""
    steps: list[None] = []
    return test.run(groups, lambda: steps.append(None)), len(steps)


@pytest.mark.parametrize("env", ["point_robot_wind", "noisy_robot", "hopper_params"])
def test_a_group_beside_others_is_what_it_is_alone(
    env: str, request: pytest.FixtureRequest
) -> None:
    if env == "noisy_robot":
        request.getfixturevalue("noisy_robot")
    test = MetaTest(*networks(env), task_set(env), CONFIG, SEED)
    sizes = MetaEnv(env)
    (obs,), (act,) = sizes.observation_space.shape or (), sizes.action_space.shape or ()
    data = torch.rand(6, 5, 2 * obs + act + 1, generator=torch.Generator().manual_seed(1))
    groups = {
        "few": Group(ROWS),
        "one": Group(np.array([3])),
        "many": Group(np.array([9, 4, 1, 2, 8, 0, 7])),
        "online": Group(ROWS, "online"),
        "offline": Group(ROWS, "offline", data),
        "codes": Group(
            ROWS, "codes", codes=torch.rand(2, Z, generator=torch.Generator().manual_seed(2))
        ),
    }
    alone: dict[str, MetaTestResult] = {}
    lengths: dict[str, int] = {}
    for name, group in groups.items():
        found, lengths[name] = counted(test, {name: group})
        alone |= found
    for threads in (1, 2, 2):
        beside, steps = counted(dataclasses.replace(test, threads=threads), groups)
        assert [*beside] == [*groups]
        for name in groups:
            assert same(beside[name], alone[name]), name
        # One pass: nobody waits for another's episodes.
        assert steps == max(lengths.values())
        groups = dict(reversed(groups.items()))
    early = env != "point_robot_wind"
    assert len({lengths[name] for name in ("few", "one", "many")}) == (3 if early else 1), lengths
    assert lengths["few"] > lengths["online"] > lengths["offline"]
    # That any of it could have differed:
    assert not same(alone["few"], dataclasses.replace(test, seed=SEED + 1).run(groups)["few"])
    few, many = ([*groups[name].rows].index(4) for name in ("few", "many"))
    assert alone["few"].returns[0, few] != alone["many"].returns[0, many]
    for one, other in itertools.combinations(("few", "online", "offline", "codes"), 2):
        assert (alone[one].returns != alone[other].returns).any(), (one, other)


def test_what_is_called_before_each_step_can_end_it(encoder: CountingEncoder, actor: Actor) -> None:
    left = [None] * 30

    def count() -> None:
        left.pop()

    test = MetaTest(encoder, actor, task_set("point_robot_wind"), CONFIG, SEED)
    with pytest.raises(IndexError):
        test.run({"some": Group(ROWS)}, count)
    # The first episode of 25 steps is scored, and five steps explore.
    assert len(encoder.given) == 5
    assert torch.is_grad_enabled()
