"""How much is collected: one row for each environment and budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, Literal

from meta_envs import resolve


@dataclass(frozen=True)
class SACSettings:
    """Hyper-parameters of a behaviour policy's soft actor-critic.

    Attributes:
        hidden: width of each hidden layer of the actor and of both critics.
        learning_rate: of the actor, the critics and the temperature (Adam).
        batch_size: transitions an update.
        gamma: discount.
        tau: step of the target critics towards the critics, each update.
        update_every: environment steps between two bursts of as many updates.
        initial_temperature: weight of the entropy at the start; it then follows the target
            entropy, minus the dimension of the action.
    """

    hidden: tuple[int, ...]
    learning_rate: float
    batch_size: int
    gamma: float
    tau: float
    update_every: int
    initial_temperature: float


def groups_of(tasks: Sequence[int], size: int) -> tuple[tuple[int, ...], ...]:
    """Tasks in as few groups of at most `size` as there can be, as even as they can be."""
    count = -(-len(tasks) // size)
    bounds = [len(tasks) * part // count for part in range(count + 1)]
    return tuple(tuple(tasks[a:b]) for a, b in pairwise(bounds))


Precision = Literal["float32", "bfloat16"]
"""Of a fleet's matrix products and what lies between them; parameters are always float32."""


@dataclass(frozen=True)
class FleetSettings:
    """How behaviour policies are trained side by side.

    Attributes:
        size: tasks of a group, at most; one process trains a group.
        precision: of the matrix products; "auto", the hardware's best, is for budgets alone and
            never for data.
        device: kind of device that they learn on; which one of several alike makes no difference.
    """

    size: int
    precision: Precision | Literal["auto"]
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Check the size."""
        if self.size < 1:
            raise ValueError(f"a fleet has at least 1 task, got {self.size}")


@dataclass(frozen=True)
class Budget:
    """Everything that decides how one task's data are made, apart from the seed.

    Attributes:
        name: of the budget.
        steps: environment steps of the behaviour policy's training. What comes after the last
            checkpoint leaves no trace in the data, so it is not run.
        random_steps: the first of them, uniformly random and without updates.
        checkpoints: steps after which the policy is rolled out, rising.
        episodes: stochastic episodes of each checkpoint.
        reference_episodes: episodes of the random policy behind its return.
        sac: how the policy learns.
        fleet: how many learn at once; None for one process of Stable-Baselines3's SAC a task.
    """

    name: str
    steps: int
    random_steps: int
    checkpoints: tuple[int, ...]
    episodes: int
    reference_episodes: int
    sac: SACSettings
    fleet: FleetSettings | None = None

    def __post_init__(self) -> None:
        """Check that the numbers fit each other."""
        marks = (self.random_steps, *self.checkpoints)
        if not self.checkpoints or any(a >= b for a, b in pairwise(marks)):
            raise ValueError(f"checkpoints must rise from above {self.random_steps}, got {marks}")
        if marks[-1] > self.steps:
            raise ValueError(f"the last checkpoint, {marks[-1]}, is after {self.steps} steps")
        if any(mark % self.sac.update_every for mark in marks):
            raise ValueError(f"{marks} must be multiples of {self.sac.update_every}, the updates'")
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")

    @property
    def updates(self) -> int:
        """Updates of a task, about: one each environment step that is not random."""
        return self.checkpoints[-1] - self.random_steps

    @property
    def total_episodes(self) -> int:
        """Episodes of a task."""
        return self.episodes * len(self.checkpoints)

    def groups(self, tasks: Sequence[int]) -> tuple[tuple[int, ...], ...]:
        """Tasks in groups that are trained side by side; each alone without a fleet."""
        return groups_of(tasks, self.fleet.size if self.fleet else 1)

    def config(self) -> dict[str, Any]:
        """All of it as JSON values, without the name."""
        values = asdict(self)
        del values["name"]
        if self.fleet is None:
            # As in datasets from before there were fleets.
            del values["fleet"]
        values["checkpoints"] = list(self.checkpoints)
        values["sac"]["hidden"] = list(self.sac.hidden)
        return values


# The field's layers for the point robots, two of 1024 units, are for MuJoCo. These settings were
# chosen on PointRobotWind: 64 units end within 1 of the optimum in seconds a task.
_POINT_SAC = SACSettings(
    hidden=(64, 64),
    learning_rate=3e-3,
    batch_size=128,
    gamma=0.9,
    tau=0.01,
    update_every=20,
    initial_temperature=0.1,
)
# Where the goal varies, policies that head for it from their first checkpoint on would give it away
# by the positions they visit, and no context would have to read it off rewards, as contexts of
# random actions must. The field's learning rate goes astray for a third of the checkpoints.
_GOAL_SAC = replace(_POINT_SAC, learning_rate=1e-4)
_POINT_PAPER = Budget(
    name="paper",
    steps=5_000,
    random_steps=2_000,
    checkpoints=tuple(range(2_200, 5_000, 200)),
    episodes=50,
    reference_episodes=1_000,
    sac=_POINT_SAC,
    fleet=FleetSettings(25, "auto"),
)
_POINT_SMOKE = Budget(
    name="smoke",
    steps=100,
    random_steps=60,
    checkpoints=(80, 100),
    episodes=4,
    reference_episodes=100,
    sac=replace(_POINT_SAC, hidden=(16, 16), batch_size=32, update_every=10),
    fleet=FleetSettings(25, "auto"),
)


def _point_rows(sac: SACSettings) -> dict[str, Budget]:
    """A point robot's budgets: the standard and the quick one are the paper's.

    More steps teach the behaviour policies of PointRobot and SparsePointRobot more, but CTMRL was
    worse on their data in the trials of docs/fleet.md.
    """
    paper = replace(_POINT_PAPER, sac=sac)
    same = (replace(paper, name=name) for name in ("standard", "quick"))
    return {row.name: row for row in (paper, *same, _POINT_SMOKE)}


# The field's discount, target rate and first temperature. Small networks and a high rate learn most
# in an hour of a small machine; docs/fleet.md has the learning curves.
_ROBOT_SAC = SACSettings(
    hidden=(64, 64),
    learning_rate=1e-3,
    batch_size=128,
    gamma=0.99,
    tau=0.005,
    update_every=20,
    initial_temperature=0.1,
)
_ROBOT_STEPS = {"ant": 40_000, "half": 70_000, "hopper": 340_000, "walker": 400_000}
"""Of the standard budget, by the first word of an environment's name, where not 100,000."""
_QUICK_STEPS = 40_000
"""Of the quick budget: from half of what the standard one teaches (hopper, walker) to all (ant)."""


def _robot_budget(name: str, steps: int) -> Budget:
    """The field's protocol, at fewer steps and with fewer episodes of each checkpoint."""
    every = steps // 20
    return Budget(
        name=name,
        steps=steps,
        random_steps=every,
        checkpoints=tuple(range(2 * every, steps, every)),
        episodes=10,
        reference_episodes=10,
        sac=_ROBOT_SAC,
        fleet=FleetSettings(25, "auto"),
    )


_ROBOT_PAPER = Budget(
    name="paper",
    steps=1_000_000,
    random_steps=50_000,
    checkpoints=tuple(range(100_000, 1_000_000, 50_000)),
    episodes=50,
    reference_episodes=10,
    sac=replace(_ROBOT_SAC, hidden=(1024, 1024), learning_rate=1e-4, batch_size=1024),
    fleet=FleetSettings(10, "auto"),
)
_ROBOT_SMOKE = Budget(
    name="smoke",
    steps=400,
    random_steps=200,
    checkpoints=(300, 400),
    episodes=2,
    reference_episodes=2,
    sac=replace(_ROBOT_SAC, hidden=(16, 16), batch_size=32),
    fleet=FleetSettings(25, "auto"),
)


def _robot_rows(env: str) -> dict[str, Budget]:
    standard = _robot_budget("standard", _ROBOT_STEPS.get(env.partition("_")[0], 100_000))
    quick = _robot_budget("quick", _QUICK_STEPS)
    return {row.name: row for row in (_ROBOT_PAPER, standard, quick, _ROBOT_SMOKE)}


_ROBOTS = (
    "half_cheetah_vel",
    "hopper_params",
    "walker_params",
    "ant_goal",
    "half_cheetah_dir",
    "ant_dir",
    "humanoid_dir",
    "hopper_mass",
    "hopper_friction",
    "walker_mass",
    "walker_friction",
)

BUDGETS: dict[str, dict[str, Budget]] = {
    "point_robot": _point_rows(_GOAL_SAC),
    "point_robot_wind": _point_rows(_POINT_SAC),
    "sparse_point_robot": _point_rows(_GOAL_SAC),
    **{env: _robot_rows(env) for env in _ROBOTS},
}
"""Budgets by the environment's short name and the budget's name."""


def other_options(env: str, name: str, config: Mapping[str, Any]) -> list[str]:
    """The options with which a command collects what a budget alone would not, as its words.

    Args:
        env: any of the environment's names.
        name: of the budget.
        config: `Budget.config()` of the data.

    Raises:
        ValueError: there is no such environment or budget.
        KeyError: the config lacks something.
        TypeError: the config has something of another kind.
    """
    own, episodes, fleet = budget(env, name), int(config["episodes"]), config.get("fleet")
    words = [] if episodes == own.episodes else ["--episodes", str(episodes)]
    if fleet is None:
        return [*words, "--engine", "sb3"]
    size, device = int(fleet["size"]), str(fleet["device"])
    # On a GPU a command takes all tasks by itself.
    if own.fleet is None or device != "cpu" or size != own.fleet.size:
        words += ["--fleet-size", str(size)]
    words += ["--precision", str(fleet["precision"])]
    return words if device == "cpu" else [*words, "--device", device]


def budget(env: str, name: str, episodes: int | None = None) -> Budget:
    """Find a budget.

    Args:
        env: any of the environment's names.
        name: of the budget.
        episodes: episodes of each checkpoint instead of the budget's own.

    Raises:
        ValueError: there is no such environment or budget, or `episodes` is below 1.
    """
    rows = BUDGETS.get(resolve(env).name, {})
    if name not in rows:
        known = f"known: {', '.join(rows)}" if rows else "it has none"
        raise ValueError(f"{resolve(env).name} has no budget '{name}' ({known})")
    found = rows[name]
    return found if episodes is None else replace(found, episodes=episodes)
