"""Everything a run is made of, as frozen dataclasses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.errors import UsageError
from ctmrl.meta_test import MetaTestConfig
from ctmrl.methods.base import MethodConfig
from datagen.dataset import Quality

Preset = Literal["standard", "paper", "smoke"]
Precision = Literal["auto", "float32", "bfloat16"]
Beside = Literal["auto", "always", "never"]


@dataclass(frozen=True)
class MetaTrainConfig:
    """Hyper-parameters of meta-training that no method changes."""

    steps: int = 6_000
    """Gradient steps."""
    meta_batch: int = 16
    """B, training tasks in a batch, all different (fewer if there are fewer)."""
    batch_size: int = 32
    """Transitions of each task for the actor-critic."""
    context_episodes: int = 2
    """Episodes behind one context."""
    context_size: int = 16
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
    """Context-learning method: ctmrl, ctmrl_released (as its published code has it) or focal; or a
    reference: oracle_task (given the true task) or no_context."""
    preset: Preset = "standard"
    """Where the defaults of all other options come from: standard, paper (sizes of the field, hours
    on a small machine) or smoke (seconds, learns little)."""
    seed: int = 0
    """Of everything random in the run."""
    seeds: tuple[int, ...] = ()
    """In place of --seed: train all of these side by side, each in a process of its own and to what
    it makes alone, into seed-<n> of --out or of runs/<environment>/<method>."""
    workers: int | None = None
    """Most of --seeds to train at a time; default one for each core, or each --threads cores."""
    data: Path | None = None
    """Dataset folder; default datasets/<environment>."""
    quality: Quality = "mixed"
    """Learn from the behaviour of these checkpoints alone: mixed (all), early, medium or expert;
    docs/dataset_format.md defines them and python -m datagen.inspect counts them."""
    data_episodes: int | None = None
    """Learn from the first this many episodes of each checkpoint; default all."""
    out: Path | None = None
    """Run folder; default runs/<environment>/<method>/seed-<n>."""
    validate: bool = False
    """Hold every fifth training task out and report on those as the unseen tasks: for choosing
    settings without looking at the meta-test tasks."""
    restart: bool = False
    """Throw away what the run folder holds and begin anew."""
    threads: int = 1
    """Threads of the numerical libraries; part of what makes a run repeatable."""
    precision: Precision = "float32"
    """Of the networks' matrix products in meta-training; all else, and every measured return, is
    float32. auto is bfloat16 where the hardware multiplies it faster (AMX, most GPUs, some AVX-512)
    and float32 elsewhere; a run goes on in the precision it began with. The MuJoCo robots' default
    is auto."""
    device: str = "cpu"
    """Where meta-training computes: cpu, cuda, or cuda:1 for the second GPU. On a GPU a gradient
    step is one CUDA graph, which --seeds share it with. Evaluation is on the processor. A run goes
    on on the kind of device it began on."""
    memory: float | None = None
    """GB of memory the training data may take as a table; default half of what is available. A
    larger table is read from a file beside the run, which ends with the process and changes no
    result; 0 always does that."""
    beside: Beside = "auto"
    """Measure the returns on training tasks while training goes on: auto where the process has a
    core that neither --threads nor other --seeds take. Changes no result; rows and checkpoints are
    written when their return is known."""
    loggers: tuple[str, ...] = ()
    """Where metrics go beside metrics.csv: any of tensorboard, trackio and wandb, each an extra
    (pip install 'ctmrl[wandb]'). docs/metrics.md lists the metrics."""

    @property
    def label(self) -> str:
        """The method, with the slice of the data or the split that is its own: a report's rows."""
        words = [self.method]
        if self.quality != "mixed":
            words.append(self.quality)
        if self.data_episodes is not None:
            words.append(f"{self.data_episodes}-episodes")
        if self.validate:
            words.append("validation")
        return "-".join(words)


_SHARE = (0.0, 1.0)
_WEIGHTS = (
    "code_contrast",
    "cross_prediction",
    "contrast",
    "metric",
    "club",
    "commitment",
    "cycle",
)
_BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("steps", "batch_size", "context_episodes", "context_size"), (1, math.inf)),
    **dict.fromkeys(("scored_episodes", "repetitions", "z_dim", "dual_steps"), (1, math.inf)),
    # Far more of them, and the libraries crash.
    "threads": (1, 1024),
    **dict.fromkeys(("hidden", "encoder_hidden", "predictor_hidden"), (1, math.inf)),
    **dict.fromkeys(("random_episodes", "policy_episodes", "extra_negatives"), (0, math.inf)),
    **dict.fromkeys(("learning_rate", "encoder_lr", "dual_lr", "regularizer"), (0, math.inf)),
    **dict.fromkeys(("gamma", "target_rate", "eta", "warm_up", "refresh"), _SHARE),
    **dict.fromkeys(("reward_scale", "tau"), (1e-9, math.inf)),
    **dict.fromkeys(("behavior_cloning", "cloning_advantage", "cloning_rank"), (0, math.inf)),
    **dict.fromkeys((f"{name}_weight" for name in _WEIGHTS), (0, math.inf)),
    **dict.fromkeys(("divergence_initial", "divergence_maximum"), (0, math.inf)),
    "code_decay": _SHARE,
    "value_expectile": _SHARE,
    "data_episodes": (1, math.inf),
    "meta_batch": (2, math.inf),
    "memory": (0, math.inf),
    **dict.fromkeys(("seed", "seeds"), (0, 2**63 - 1)),
    "workers": (1, math.inf),
}
"""Least and largest value of the options that have them."""
_UNLIMITED = {"memory"}
"""Options that may be infinite."""


def check_settings(config: Any) -> None:
    """Check that every number is in its range.

    Args:
        config: a RunConfig, or another dataclass with fields of the same names.

    Raises:
        UsageError: the first one that is not.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            check_settings(value)
        elif value is not None and (wanted := _wanted(field.name, value)):
            option = field.name.replace("_", "-")
            raise UsageError(f"--{option} must be {wanted}, got {value}")


def _wanted(name: str, value: Any) -> str | None:
    """What an option has to be, None where its value is that."""
    numbers = value if isinstance(value, tuple) else (value,)
    if name in _BOUNDS:
        low, high = _BOUNDS[name]
        if not all(low <= number <= high for number in numbers):
            return f"at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
    if name in _UNLIMITED or all(math.isfinite(one) for one in numbers if isinstance(one, float)):
        return None
    return "a finite number"
