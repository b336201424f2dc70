"""The meta-training loop and all of its state."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor, nn

from ctmrl.actor_critic import ActorCritic
from ctmrl.agent import Agent, build_method, part
from ctmrl.codebook import SHARE
from ctmrl.config import MetaTrainConfig, RunConfig
from ctmrl.data import OfflineData, split_batches
from ctmrl.errors import UsageError
from ctmrl.methods.base import Dimensions
from ctmrl.networks import mean_encoding
from ctmrl.numbers import Numbers, Source
from ctmrl.precision import Precision, products_in
from ctmrl.recording import Given, RecordedStep
from ctmrl.soundness import check_sound, q_limit
from datagen.accelerator import check_precision

LARGEST_Q = "policy/q_largest"
"""The metric that is a maximum over steps; the others are means."""
LAST_RATE = 0.01
"""Share of the learning rates left at the end of a decaying run."""


def usable_precision(config: RunConfig) -> Precision:
    """The precision of a run's steps on its device.

    Raises:
        UsageError: the device cannot be used.
    """
    try:
        return check_precision(config.precision, config.device)
    except ValueError as error:
        raise UsageError(str(error)) from None


class Learner:
    """Method, actor-critic, optimisers and generator of one run, and one gradient step of them.

    Attributes:
        step: gradient steps taken.
        device: where steps are computed; it decides nothing of what they draw.
        precision: of the networks' matrix products in a step.
        method: the context-learning method.
        actor_critic: the actor-critic.
        optimizers: every optimiser by name; each parameter is in exactly one.
    """

    def __init__(self, config: RunConfig, data: OfflineData) -> None:
        """Build everything from the run's seed.

        Raises:
            UsageError: settings that do not fit the dataset or the machine, one sentence.
        """
        self.config: MetaTrainConfig = config.training
        self.data = data
        self.step = 0
        self.precision = usable_precision(config)
        self.device = torch.device(config.device)
        statistics = data.statistics(config.context.next_obs_in_context)
        dims = Dimensions(data.obs_dim, data.act_dim, len(data), config.training.steps)
        policy = config.actor_critic
        with torch.random.fork_rng():
            torch.manual_seed(config.seed)
            self.method = build_method(config, statistics, dims)
            start = data.mean_value(policy.gamma) if policy.value_from_data else 0.0
            self.actor_critic = ActorCritic(
                policy, statistics, data.act_dim, self.method.encoder.z_dim, start
            )
        data.check_episodes(self.method.context_sets, config.training.context_episodes)
        data.to(self.device)
        self.method.to(self.device)
        self.actor_critic.to(self.device)
        # The host's on every device.
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
        self._rows_a_task = policy.batches * config.training.batch_size
        self._numbers = Numbers(self.generator, self.device)
        self._recorded: RecordedStep | None = None
        if self.device.type == "cuda":
            self.record()
        entropy = self.actor_critic.entropy_coef * data.act_dim
        self._limits = {LARGEST_Q: q_limit(data.largest_reward, entropy, config.actor_critic.gamma)}

    @property
    def agent(self) -> Agent:
        """The agent as it is now, on the host."""
        agent = Agent(self.method, self.actor_critic.actor)
        if self.device.type == "cpu":
            return agent
        return Agent(copy.deepcopy(agent.method).cpu(), copy.deepcopy(agent.actor).cpu())

    def record(self) -> None:
        """From now on take steps as recordings of a GPU."""
        self._recorded = RecordedStep(
            lambda given, source: self._step(given, source)[0], self.generator, self.device
        )
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["capturable"] = True
                # A recording reads it anew each time.
                group["lr"] = torch.tensor(group["lr"], dtype=torch.float32, device=self.device)

    def all_contexts(self) -> Tensor:
        """One fresh context of every training task, [T, Z], without gradients."""
        with torch.no_grad():
            return mean_encoding(self.method.encoder(self._draw(self._every, 1))[0])

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
            self.data.page_in(self.data.batch_rows(tasks, self._rows_a_task, ahead))

    def update(self, look: Callable[[dict[str, Tensor]], None] | None = None) -> dict[str, Tensor]:
        """One gradient step.

        Args:
            look: called at the end with all the step is made of, in the order it came about.

        Returns:
            Scalars by metric name.
        """
        self._set_rates()
        self.method.before_step(self.step, self.all_contexts)
        tasks = self._draw_tasks(self.generator)
        given = Given(
            self._draw(tasks, self.method.context_sets),
            self.data.transitions(tasks, self._rows_a_task, self.generator),
            self.data.params[tasks],
        )
        if self._recorded is None or look is not None:
            metrics, made = self._step(given, self._numbers, self._page_in)
            self.step += 1
            if look is not None:
                look(made)
                look(self._gradients_and_parameters())
            return metrics
        metrics = self._recorded(given, self.method.phase)
        self._page_in()
        self.step += 1
        return metrics

    def _step(
        self, given: Given, source: Source, drawn: Callable[[], None] = lambda: None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """All of a step that is computed, so that a GPU can record it.

        Args:
            given: what the data give it.
            source: of its random numbers.
            drawn: called when it has taken all of them, before the gradients.

        Returns:
            Scalars by metric name; and all the step is made of, in the order it came about.
        """
        contexts, rows, params = given
        with products_in(self.precision):
            encodings = self.method.encoder(contexts)
            context_loss, metrics = self.method.context_loss(contexts, encodings, source)
            # Detached: the actor-critic must not train the encoder. It has the first set's.
            z = mean_encoding(encodings.detach())
            self.method.encoder.show(z)
            told = self.method.encoder.scaled(self.method.encoder.told(z[0], params))
            repeated = told.repeat_interleave(self.config.batch_size, dim=0)
            batch, *further = split_batches(rows, len(told), self.actor_critic.config.batches)
            policy_loss, more = self.actor_critic.loss(batch, repeated, source, further)
        drawn()
        loss = context_loss + policy_loss
        self.optimizers["main"].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call] # torch's own
        self.optimizers["main"].step()
        self.actor_critic.follow_value()
        metrics |= _spread(z) | more
        data = {f"data/{name}": values for name, values in rows._asdict().items()}
        made = {"data/context": contexts, **data, "contexts": z, "contexts as told": told}
        made |= {**metrics, "loss": loss}
        return metrics, made

    def _gradients_and_parameters(self) -> dict[str, Tensor]:
        gradients, parameters = {}, {}
        for owner, module in self._modules().items():
            for name, parameter in module.named_parameters():
                parameters[f"{owner}.{name}"] = parameter.detach()
                if parameter.grad is not None:
                    gradients[f"the gradient of {owner}.{name}"] = parameter.grad
        return gradients | parameters

    def check(self, quantities: Mapping[str, Tensor]) -> None:
        """Check that nothing is wrong with quantities of the step just taken.

        Raises:
            Diverged: the first one that is not finite, or beyond its limit.
        """
        check_sound(self.step, quantities, self._limits)

    def check_all(self, metrics: Mapping[str, Tensor]) -> None:
        """Check metrics, and all there is to continue from.

        Raises:
            Diverged: the first one that is not finite, or beyond its limit.
        """
        state = {name: x for name, x in self.state().items() if x.is_floating_point()}
        self.check({**metrics, **state})

    def retrace(self, state: dict[str, Tensor]) -> None:
        """Take the steps since an earlier, sound state again, looking at everything in each.

        Raises:
            Diverged: the first thing that is wrong, at its step.
        """
        last = self.step
        self.load(state)
        while self.step < last:
            self.update(self.check)

    def _set_rates(self) -> None:
        left = 1.0 - self.step / self.config.steps
        factor = LAST_RATE + (1 - LAST_RATE) * left if self.config.decay else 1.0
        for name, optimizer in self.optimizers.items():
            for group, rate in zip(optimizer.param_groups, self._rates[name], strict=True):
                if isinstance(group["lr"], Tensor):
                    group["lr"].fill_(rate * factor)
                else:
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
            self.actor_critic.multiplier.value.copy_(state["multiplier"])
        if self._recorded is not None:
            self._recorded.renew()


def _spread(z: Tensor) -> dict[str, Tensor]:
    """Standard deviations of contexts [sets, B, Z], means over coordinates.

    That between tasks is of the first set; that within a task needs two sets.
    """
    between = {"contexts/between": z[0].std(dim=0).mean()}
    if len(z) == 1:
        return between
    return between | {"contexts/within": z.var(dim=0).mean(dim=0).sqrt().mean()}


def _row(step: int, sums: dict[str, Tensor], count: int) -> dict[str, float]:
    """Mean metrics of `count` steps; with codes also how many no task of them matched."""
    means = {k: float(v) / (1 if k == LARGEST_Q else count) for k, v in sums.items()}
    row = {"step": step} | means
    shares = [value for key, value in row.items() if key.startswith(SHARE)]
    return row | ({"codes/dead": float(shares.count(0.0))} if shares else {})


def _advance(learner: Learner, log_every: int) -> dict[str, float]:
    """Take the steps up to the next row, and give it; or raise Diverged."""
    sums: dict[str, Tensor] = {}
    count = 0
    while count == 0 or (learner.step % log_every and learner.step < learner.config.steps):
        for key, value in learner.update().items():
            add = torch.maximum if key == LARGEST_Q else torch.add
            sums[key] = add(sums[key], value) if key in sums else value
        count += 1
    learner.check_all(sums)
    return _row(learner.step, sums, count)


def meta_train(
    learner: Learner, log_every: int, save: Callable[[], None], save_every: int
) -> Iterator[dict[str, float]]:
    """Train to the end, yielding the mean metrics of every `log_every` steps.

    Args:
        learner: where to begin; its step may be above 0.
        log_every: steps between two yields; metrics are means over them.
        save: called every `save_every` steps, after the yield that ends there, and at the end.
        save_every: a multiple of `log_every`.

    Raises:
        Diverged: something went wrong in the steps since the last yield; nothing of them is yielded
            or saved.
    """
    steps = learner.config.steps
    while learner.step < steps:
        sound = {key: value.clone() for key, value in learner.state().items()}
        try:
            row = _advance(learner, log_every)
        except ValueError:
            # It diverged, or K-means was given what is not finite. What went wrong first may be
            # steps behind what was noticed.
            learner.retrace(sound)
            raise
        yield row
        if learner.step % save_every == 0 or learner.step == steps:
            save()
