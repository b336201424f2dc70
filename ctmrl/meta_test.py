"""The meta-test: adapt to a task by one of the field's protocols, then score fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.networks import Actor, Encoder
from ctmrl.protocols import Protocol
from meta_envs import MetaVectorEnv, TaskSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MetaTestConfig:
    """How much an agent may explore a task before it is scored, as np_online does.

    The other protocols that explore have as many episodes.
    """

    random_episodes: int = 10
    """Phase one: episodes of uniformly random actions."""
    policy_episodes: int = 10
    """Phase two: episodes of the stochastic policy, each on the context of all before it."""
    scored_episodes: int = 1
    """Fresh episodes of the deterministic policy on the final context, their mean is the return."""
    repetitions: int = 4
    """Independent repetitions of the whole adaptation of each task."""


class Group(NamedTuple):
    """Tasks to adapt to side by side, and how.

    Attributes:
        rows: n tasks of the task set.
        protocol: how contexts come about.
        data: for `offline`, the tasks' transitions [R * n, T, O + A + 1 + O], repetition by
            repetition.
        codes: for `codes`, contexts to act on before there are others, [N, Z].
    """

    rows: NDArray[np.int64]
    protocol: Protocol = "np_online"
    data: Tensor | None = None
    codes: Tensor | None = None


class MetaTestResult(NamedTuple):
    """What a meta-test of n tasks gave; E exploration episodes, R repetitions.

    Attributes:
        returns: final return of each repetition and task, [R, n].
        curve: return of one deterministic episode after 0..E exploration episodes, mean over
            repetitions, [E + 1, n]; of `online` the exploration episodes are those.
        contexts: what the policy is told at last, of each repetition and task, not standardised,
            [R, n, Z].
    """

    returns: Floats
    curve: Floats
    contexts: NDArray[np.float32]


Act = Callable[[Tensor], NDArray[np.float32]]
"""Actions [n, A] for observations [n, O]."""


class _Seen(NamedTuple):
    """What a step showed a group of n sub-environments.

    Attributes:
        obs: the observations after it, [n, O].
        reward: what counts, [n].
        read: the reward that goes into the context, [n].
        over: whether the episode is, [n].
    """

    obs: NDArray[np.float32]
    reward: Floats
    read: Floats
    over: NDArray[np.bool_]


Episode = Generator[NDArray[np.float32], _Seen, Floats]
"""Gives actions [n, A], is sent what they led to, and ends in returns [n]."""
Exploration = Generator[NDArray[np.float32], _Seen, list[Floats]]
"""The same for a group's exploration; ends in the returns on the way."""
Episodes = Generator[NDArray[np.float32], _Seen, MetaTestResult]
"""The same for all episodes of a group; ends in its result."""


class _Adaptation:
    """Tasks side by side in some rows of a vector environment, each with a context of its own.

    Its random numbers, its environments and its batches for the networks are its own, so that what
    the other rows hold does not change a bit of it.
    """

    def __init__(self, env: MetaVectorEnv, rows: slice, test: MetaTest) -> None:
        self.env, self.rows, self.encoder, self.actor = env, rows, test.encoder, test.actor
        self.mask = np.zeros(env.num_envs, dtype=np.bool_)
        self.mask[rows] = True
        self.params = torch.tensor(env.params[rows], dtype=torch.float32)
        self.size = len(self.params)
        self.shape = (self.size, *(env.single_action_space.shape or ()))
        self.noise = np.random.default_rng(test.seed)
        self.generator = torch.Generator().manual_seed(test.seed)
        self.total = torch.zeros(self.size, self.encoder.z_dim, dtype=torch.float64)
        self.count = torch.zeros(self.size, 1, dtype=torch.float64)
        self.chosen: Tensor | None = None
        """What the policy is told in place of contexts, [n, Z]."""

    def read(self, context: Tensor) -> None:
        """Add transitions [n, T, F] of each task to its context."""
        self.total += self.encoder(context).double().sum(dim=1)
        self.count += context.shape[1]

    @property
    def context(self) -> Tensor:
        """The contexts so far, [n, Z]; 0 before any transition."""
        return (self.total / self.count.clamp_min(1.0)).float()

    @property
    def told(self) -> Tensor:
        """What the policy is told when it is scored: the contexts, or what was chosen, [n, Z]."""
        mean = self.context if self.chosen is None else self.chosen
        return self.encoder.told(mean, self.params)

    @property
    def z(self) -> Tensor:
        """The same as the policy's network gets it."""
        return self.encoder.scaled(self.told)

    def random(self, obs: Tensor) -> NDArray[np.float32]:
        """Uniform actions."""
        return self.noise.uniform(-1.0, 1.0, self.shape).astype(np.float32)

    def stochastic(self, z: Tensor) -> Act:
        """The policy's samples on fixed contexts."""
        return lambda obs: self.actor.sample(obs, z, self.generator).action.numpy()

    def deterministic(self, z: Tensor) -> Act:
        """The policy's means on fixed contexts."""
        return lambda obs: self.actor.act(obs, z).numpy()

    def episode(self, act: Act, explore: bool) -> Episode:
        """Returns [n] of one episode each; `explore` adds its transitions to the context."""
        obs = self.env.reset(options={"reset_mask": self.mask})[0][self.rows]
        running = np.ones(self.size, dtype=np.bool_)
        returns = np.zeros(self.size)
        while running.any():
            action = act(torch.from_numpy(obs))
            seen = yield action
            returns += np.where(running, seen.reward, 0.0)
            if explore:
                rows = (obs, action, seen.read[:, None].astype(np.float32), seen.obs)
                encoded = self.encoder(torch.from_numpy(np.concatenate(rows, axis=1)))
                keep = torch.from_numpy(running)[:, None]
                self.total += torch.where(keep, encoded.double(), 0.0)
                self.count += keep
            running &= ~seen.over
            obs = seen.obs
        return returns

    def score(self) -> Episode:
        """Returns [n] of one deterministic episode on what the policy is told now."""
        return self.episode(self.deterministic(self.z), explore=False)

    def explore(self, group: Group, config: MetaTestConfig) -> Exploration:
        """Fill the contexts; gives the returns [n] that the curve has before its last."""
        curve: list[Floats] = []
        episodes = config.random_episodes + config.policy_episodes
        if group.protocol == "codes" and group.codes is not None:
            curve = yield from self._explore_codes(group.codes, config)
        elif group.protocol == "online":
            for _ in range(episodes):
                act = self.deterministic(self.z)
                curve.append((yield from self.episode(act, explore=True)))
        elif group.protocol == "np_online":
            for number in range(episodes):
                curve.append((yield from self.score()))
                random = number < config.random_episodes
                act = self.random if random else self.stochastic(self.z)
                yield from self.episode(act, explore=True)
        return curve

    def _explore_codes(self, codes: Tensor, config: MetaTestConfig) -> Exploration:
        """Act on codes [N, Z] in turn, then on the context of the episode that returned most.

        Chosen for the score is what the policy was told in that episode, the earliest of equals.
        """
        curve: list[Floats] = []
        self.chosen = self.context
        best = np.full(self.size, -np.inf)
        for number in range(config.random_episodes + config.policy_episodes):
            curve.append((yield from self.score()))
            on_code = number < config.random_episodes
            told = codes[number % len(codes)].expand(self.size, -1) if on_code else self.context
            before = self.total, self.count, self.chosen
            self.total, self.count = torch.zeros_like(self.total), torch.zeros_like(self.count)
            act = self.stochastic(self.encoder.scaled(told))
            returns = yield from self.episode(act, explore=True)
            better = torch.from_numpy(returns > best)[:, None]
            after = self.total, self.count, told
            self.total, self.count, self.chosen = (
                torch.where(better, new, old) for new, old in zip(after, before, strict=True)
            )
            best = np.maximum(best, returns)
        return curve

    def episodes(self, group: Group, config: MetaTestConfig) -> Episodes:
        """The whole adaptation."""
        curve = yield from self.explore(group, config)
        last = []
        for _ in range(config.scored_episodes):
            last.append((yield from self.score()))
        scored = np.mean(last, axis=0)
        curve.append(scored)
        shape = (config.repetitions, self.size // config.repetitions)
        return MetaTestResult(
            scored.reshape(shape),
            np.stack(curve).reshape(-1, *shape).mean(axis=1),
            self.told.numpy().reshape(*shape, -1),
        )


@dataclass(frozen=True)
class MetaTest:
    """A meta-test of any groups of tasks, all side by side in one vector environment.

    Attributes:
        encoder: makes contexts from transitions.
        actor: acts on contexts.
        tasks: the task set.
        config: how much of everything.
        seed: of random actions, policy noise and the environments, in each group anew.
        threads: that step the environments; as many as there are by default. No number depends on
            them.
    """

    encoder: Encoder
    actor: Actor
    tasks: TaskSet
    config: MetaTestConfig
    seed: int
    threads: int | None = None

    @torch.no_grad()
    def run(
        self,
        groups: Mapping[str, Group],
        each_step: Callable[[], None] | None = None,
    ) -> dict[str, MetaTestResult]:
        """Adapt to each task of some groups and score it; the results by the groups' names.

        A group goes through its episodes at its own pace. Its result is what it would be without
        the others, bit for bit.

        Args:
            groups: tasks and protocols by name.
            each_step: called before each step; what it raises ends the meta-test.

        Raises:
            ValueError: an offline group without data, one of `codes` without codes, or another one
                with either.
        """
        for name, group in groups.items():
            if (group.protocol == "offline") != (group.data is not None):
                raise ValueError(f"group {name!r}: offline contexts need data, no others take any")
            if (group.protocol == "codes") != (group.codes is not None):
                raise ValueError(f"group {name!r}: 'codes' needs codes, no others take any")
        repetitions = self.config.repetitions
        rows = {name: np.tile(group.rows, repetitions) for name, group in groups.items()}
        every = np.concatenate([*rows.values()])
        env = MetaVectorEnv(self.tasks.env, tasks=every, task_set=self.tasks, threads=self.threads)
        env.reset(seed=[self.seed + place for own in rows.values() for place in range(len(own))])
        dense = self.encoder.sees_dense_reward and env.definition.sparse
        actions = np.zeros(env.action_space.shape or (), dtype=np.float32)
        at_work: dict[str, tuple[_Adaptation, Episodes]] = {}
        begin = 0
        for name, group in groups.items():
            place = slice(begin, begin + len(rows[name]))
            begin = place.stop
            adaptation = _Adaptation(env, place, self)
            if group.data is not None:
                adaptation.read(group.data)
            episodes = adaptation.episodes(group, self.config)
            actions[place] = next(episodes)
            at_work[name] = adaptation, episodes
        results: dict[str, MetaTestResult] = {}
        while at_work:
            if each_step is not None:
                each_step()
            obs, reward, terminated, truncated, info = env.step(actions)
            read, over = info["dense_reward"] if dense else reward, terminated | truncated
            for name, (adaptation, episodes) in [*at_work.items()]:
                place = adaptation.rows
                seen = _Seen(obs[place], reward[place], read[place], over[place])
                try:
                    actions[place] = episodes.send(seen)
                except StopIteration as stop:
                    results[name] = stop.value
                    env.rest(adaptation.mask)
                    del at_work[name]
        return {name: results[name] for name in groups}


def meta_test(
    encoder: Encoder,
    actor: Actor,
    tasks: TaskSet,
    rows: NDArray[np.int64],
    config: MetaTestConfig,
    seed: int,
) -> MetaTestResult:
    """The meta-test of one group of tasks; see `MetaTest` for the arguments."""
    return MetaTest(encoder, actor, tasks, config, seed).run({"": Group(rows)})[""]
