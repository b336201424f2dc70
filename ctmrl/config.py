"""Everything a run is made of, as frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.meta_test import MetaTestConfig
from ctmrl.methods.base import MethodConfig

Preset = Literal["standard", "paper", "smoke"]


@dataclass(frozen=True)
class MetaTrainConfig:
    """Hyper-parameters of meta-training that no method changes."""

    steps: int = 12_000
    """Gradient steps."""
    meta_batch: int = 16
    """B, training tasks in a batch, all different (fewer if there are fewer)."""
    batch_size: int = 32
    """Transitions of each task for the actor-critic."""
    context_episodes: int = 2
    """Episodes behind one context."""
    context_size: int = 32
    """Transitions of one context, drawn from its episodes."""
    decay: bool = True
    """Let all learning rates fall linearly, to a hundredth at the end."""


@dataclass(frozen=True)
class RunConfig:
    """Train a method on an offline dataset and meta-test it on tasks it never saw.

    Without an argument: CTMRL on the starter dataset of PointRobotWind, which comes with the
    repository. The run folder gets config.json, metrics.csv, checkpoint.pt, evaluation.json and two
    pictures. Interrupted runs continue where they were when the same command is given again.
    """

    training: MetaTrainConfig
    actor_critic: ActorCriticConfig
    context: MethodConfig
    meta_test: MetaTestConfig
    env: str = "point_robot_wind"
    """Environment: short name, id or hyphenated name."""
    method: str = "ctmrl"
    """Context-learning method: ctmrl or focal."""
    preset: Preset = "standard"
    """Where the defaults of all other options come from: standard, paper (sizes of the field, hours
    on a small machine) or smoke (seconds, learns little)."""
    seed: int = 0
    """Of everything random in the run."""
    data: Path | None = None
    """Dataset folder; default datasets/<environment>."""
    out: Path | None = None
    """Run folder; default runs/<environment>/<method>/seed-<n>."""
    validate: bool = False
    """Hold every fifth training task out and report on those as the unseen tasks: for choosing
    settings without looking at the meta-test tasks."""
    restart: bool = False
    """Throw away what the run folder holds and begin anew."""
    threads: int = 1
    """Threads of the numerical libraries; part of what makes a run repeatable."""
    tensorboard: bool = False
    """Also write TensorBoard events (needs the extra: pip install 'ctmrl[tensorboard]')."""
