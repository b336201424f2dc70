"""The meta-training loop and all of its state."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from ctmrl.actor_critic import ActorCritic
from ctmrl.agent import Agent, build_method, part
from ctmrl.config import MetaTrainConfig, RunConfig
from ctmrl.data import OfflineData
from ctmrl.methods.base import Dimensions

LAST_RATE = 0.01
"""Share of the learning rates left at the end of a decaying run."""


class Learner:
    """Method, actor-critic, optimisers and generator of one run, and one gradient step of them.

    Attributes:
        step: gradient steps taken.
        method: the context-learning method.
        actor_critic: the actor-critic.
        optimizers: every optimiser by name; each parameter is in exactly one.
    """

    def __init__(self, config: RunConfig, data: OfflineData) -> None:
        """Build everything from the run's seed.

        Raises:
            UsageError: settings that do not fit the dataset, one sentence.
        """
        self.config: MetaTrainConfig = config.training
        self.data = data
        self.step = 0
        statistics = data.statistics(config.context.next_obs_in_context)
        dims = Dimensions(data.obs_dim, data.act_dim, len(data), config.training.steps)
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            self.method = build_method(config, statistics, dims)
            self.actor_critic = ActorCritic(
                config.actor_critic, statistics, data.act_dim, self.method.encoder.z_dim
            )
        data.check_episodes(self.method.context_sets, config.training.context_episodes)
        self.generator = torch.Generator().manual_seed(config.seed)
        main = torch.optim.Adam(
            [
                {"params": list(self.method.parameters()), "lr": config.context.encoder_lr},
                {
                    "params": self.actor_critic.main_parameters(),
                    "lr": config.actor_critic.learning_rate,
                },
            ],
            fused=True,
        )
        self.optimizers: dict[str, torch.optim.Optimizer] = {"main": main}
        if self.actor_critic.dual_optimizer is not None:
            self.optimizers["dual_critic"] = self.actor_critic.dual_optimizer
        self._rates = {
            name: [group["lr"] for group in optimizer.param_groups]
            for name, optimizer in self.optimizers.items()
        }
        self._every = torch.arange(len(data))

    @property
    def agent(self) -> Agent:
        """The agent as it is now."""
        return Agent(self.method, self.actor_critic.actor)

    def all_contexts(self) -> Tensor:
        """One fresh context of every training task, [T, Z], without gradients."""
        with torch.no_grad():
            z: Tensor = self.method.encoder(self._draw(self._every, 1))[0]
            return z

    def _draw(self, tasks: Tensor, sets: int) -> Tensor:
        config = self.config
        return self.data.contexts(
            tasks, sets, config.context_episodes, config.context_size, self.generator
        )

    def _draw_tasks(self, generator: torch.Generator) -> Tensor:
        return torch.randperm(len(self.data), generator=generator)[: self.config.meta_batch]

    def _page_in(self) -> None:
        """Have the rows of the next step read from the disk, if they are there, during this one.

        They are drawn from a copy of the generator, once nothing else draws in this step. If
        something does after all, as `before_step` may, other rows are read in vain.
        """
        if self.data.in_file:
            config, ahead = self.config, self.generator.clone_state()
            tasks, sets = self._draw_tasks(ahead), self.method.context_sets
            size = (config.context_episodes, config.context_size)
            self.data.page_in(self.data.context_rows(tasks, sets, *size, ahead))
            self.data.page_in(self.data.batch_rows(tasks, config.batch_size, ahead))

    def update(self) -> dict[str, Tensor]:
        """One gradient step; scalars by metric name."""
        config, method = self.config, self.method
        self._set_rates()
        method.before_step(self.step, self.all_contexts)
        tasks = self._draw_tasks(self.generator)
        contexts = self._draw(tasks, method.context_sets)
        batch = self.data.transitions(tasks, config.batch_size, self.generator)
        z = method.encoder(contexts)
        context_loss, metrics = method.context_loss(contexts, z, self.generator)
        # The first set's contexts, detached: the actor-critic must not train the encoder.
        given = method.encoder.told(z[0].detach(), self.data.params[tasks])
        repeated = given.repeat_interleave(config.batch_size, dim=0)
        policy_loss, more = self.actor_critic.loss(batch, repeated, self.generator)
        self._page_in()
        self.optimizers["main"].zero_grad()
        (context_loss + policy_loss).backward()  # type: ignore[no-untyped-call]
        self.optimizers["main"].step()
        self.actor_critic.follow_value()
        self.step += 1
        return metrics | more | {"contexts/between": given.std(dim=0).mean()}

    def _set_rates(self) -> None:
        left = 1.0 - self.step / self.config.steps
        factor = LAST_RATE + (1 - LAST_RATE) * left if self.config.decay else 1.0
        for name, optimizer in self.optimizers.items():
            for group, rate in zip(optimizer.param_groups, self._rates[name], strict=True):
                group["lr"] = rate * factor

    def _modules(self) -> dict[str, nn.Module]:
        return {"method": self.method, "actor_critic": self.actor_critic}

    def state(self) -> dict[str, Tensor]:
        """All there is to continue from, as tensors by name."""
        found = {"step": torch.tensor(self.step), "generator": self.generator.get_state()}
        for name, module in self._modules().items():
            for key, value in module.state_dict().items():
                found[f"{name}/{key}"] = value
        for name, optimizer in self.optimizers.items():
            for index, entry in optimizer.state_dict()["state"].items():
                for key, value in entry.items():
                    found[f"optimizer/{name}/{index}/{key}"] = value
        if self.actor_critic.multiplier is not None:
            found["multiplier"] = self.actor_critic.multiplier.value
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from what `state` gave."""
        self.step = int(state["step"])
        self.generator.set_state(state["generator"])
        for name, module in self._modules().items():
            module.load_state_dict(part(state, f"{name}/"))
        for name, optimizer in self.optimizers.items():
            entries: dict[int, dict[str, Tensor]] = {}
            for key, value in part(state, f"optimizer/{name}/").items():
                index, _, what = key.partition("/")
                entries.setdefault(int(index), {})[what] = value
            groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({"state": entries, "param_groups": groups})
        if self.actor_critic.multiplier is not None:
            self.actor_critic.multiplier.value = state["multiplier"]


def meta_train(
    learner: Learner, log_every: int, save: Callable[[], None], save_every: int
) -> Iterator[dict[str, float]]:
    """Train to the end, yielding the mean metrics of every `log_every` steps.

    Args:
        learner: where to begin; its step may be above 0.
        log_every: steps between two yields; metrics are means over them.
        save: called every `save_every` steps, after the yield that ends there, and at the end.
        save_every: a multiple of `log_every`.
    """
    steps = learner.config.steps
    sums: dict[str, Tensor] = {}
    since = 0
    while learner.step < steps:
        for key, value in learner.update().items():
            sums[key] = sums[key] + value if key in sums else value
        since += 1
        if learner.step % log_every == 0 or learner.step == steps:
            yield {"step": learner.step} | {k: float(v) / since for k, v in sums.items()}
            sums, since = {}, 0
            if learner.step % save_every == 0 or learner.step == steps:
                save()
