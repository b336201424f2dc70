"""What a finished run is used for: making contexts and acting on them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ctmrl.config import RunConfig
from ctmrl.methods import METHODS
from ctmrl.methods.base import Dimensions, Method
from ctmrl.networks import Actor, Statistics
from meta_envs import task_set


@dataclass(frozen=True)
class Agent:
    """A method's encoder and the actor that acts on its contexts."""

    method: Method
    actor: Actor


def build_method(config: RunConfig, statistics: Statistics, dims: Dimensions) -> Method:
    """The untrained method of a run.

    Raises:
        UsageError: settings that do not fit the number of tasks.
    """
    return METHODS[config.method].method(config.context, statistics, dims)


def empty_statistics(dims: Dimensions, next_obs_in_context: bool, params: int) -> Statistics:
    """Statistics of the right sizes, for networks whose values a checkpoint will bring."""
    seen = dims.obs + dims.act + 1 + dims.obs * next_obs_in_context
    sizes = (dims.obs, seen, 1 + dims.obs, params)
    return Statistics(*((torch.zeros(size), torch.ones(size)) for size in sizes))


def load_agent(config: RunConfig, dims: Dimensions, state: dict[str, torch.Tensor]) -> Agent:
    """The agent of a checkpoint.

    Args:
        config: of the run.
        dims: of the run.
        state: from `Learner.state`.

    Raises:
        RuntimeError: the checkpoint does not fit the settings.
    """
    params = len(task_set(config.env).param_names)
    statistics = empty_statistics(dims, config.context.next_obs_in_context, params)
    # Initial weights are drawn from torch's global generator, though none of them stays.
    with torch.random.fork_rng():
        method = build_method(config, statistics, dims)
        z_dim = method.encoder.z_dim
        actor = Actor(statistics.obs, z_dim, config.actor_critic.hidden, dims.act)
    method.load_state_dict(part(state, "method/"))
    actor.load_state_dict(part(state, "actor_critic/actor."))
    return Agent(method, actor)


def part(state: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Entries whose names begin with `prefix`, without it."""
    return {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}
