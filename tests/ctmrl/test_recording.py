"""Steps as a GPU takes them: fit to be recorded, and the same on a stand-in for its graphs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import Diverged, UsageError
from ctmrl.meta_train import Learner, meta_train
from ctmrl.methods import METHODS
from ctmrl.numbers import Kind, Numbers, NumbersAhead
from ctmrl.recording import Given
from ctmrl.synthetic import synthetic_dataset
from ctmrl.table import Room
from ctmrl.train import check, known_settings, split_tasks
from datagen.accelerator import WARM_UP
from datagen.dataset import open_dataset
from tests.ctmrl.examples import generator
from tests.ctmrl.test_meta_train import assert_same, config_of, frozen, train
from tests.datagen.tape import Tape, pretend_cuda

STEPS = 30
"""With the schedule of `config_of` K-means runs before steps 10 and 20."""
META = torch.device("meta")
CASES = [(method, "float32") for method in METHODS] + [("ctmrl", "bfloat16")]
every_case = pytest.mark.parametrize(("method", "precision"), CASES)


def config(method: str, precision: str = "float32", decay: bool = False) -> RunConfig:
    """With behaviour regularisation, and rates that float32 has exactly.

    `oracle_task` also clones and learns the value of the data's actions, as AntGoal's presets do.
    `focal`, and what is in bfloat16, takes three steps of the dual critic, and its contexts are
    standardised.
    """
    made = config_of(method, brac=True, precision=precision, steps=STEPS, decay=decay)
    rates: dict[str, Any] = {"learning_rate": 2.0**-10, "dual_lr": 2.0**-11}
    if method == "oracle_task":
        rates |= {"behavior_cloning": 5.0, "cloning_advantage": 3.0, "value_expectile": 0.8}
    more = method == "focal" or precision == "bfloat16"
    if more:
        rates["dual_steps"] = 3
    return dataclasses.replace(
        made,
        context=dataclasses.replace(made.context, encoder_lr=2.0**-9, standardize_contexts=more),
        actor_critic=dataclasses.replace(made.actor_critic, **rates),
    )


def taped(made: RunConfig, data: OfflineData) -> Learner:
    """A learner that takes its steps as a GPU's."""
    learner = Learner(made, data)
    learner.record()
    return learner


@every_case
def test_recorded_steps_compute_the_same(
    method: str, precision: str, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = pretend_cuda(monkeypatch)
    plain = Learner(config(method, precision), wind_data)
    learner = taped(config(method, precision), wind_data)
    assert train(learner, STEPS) == train(plain, STEPS)
    assert_same(learner.state(), plain.state())
    # Anew when the codebook is placed.
    times = 2 if hasattr(plain.method, "codebook") else 1
    assert sum("record" in one for one in said) == times
    assert said.count("replay") == STEPS - times * WARM_UP


def test_rates_fall_in_recorded_steps_too(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_cuda(monkeypatch)
    plain = Learner(config("focal", decay=True), wind_data)
    learner = taped(config("focal", decay=True), wind_data)
    begin = frozen(plain.state())
    train(plain, STEPS)
    train(learner, STEPS)
    for name, value in plain.state().items():
        # The rates are rounded to float32, which after 30 steps is not much.
        near = learner.state()[name].double()
        torch.testing.assert_close(near, value.double(), rtol=1e-3, atol=1e-5)
        assert "weight" not in name or not value.equal(begin[name])
    rates = [float(group["lr"]) for group in learner.optimizers["main"].param_groups]
    wanted = [group["lr"] for group in plain.optimizers["main"].param_groups]
    assert rates == pytest.approx(wanted, rel=1e-6)
    assert rates[0] < 0.1 * 2.0**-9


@every_case
def test_recorded_steps_go_on_from_a_state(
    method: str, precision: str, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_cuda(monkeypatch)
    at = 14
    whole = taped(config(method, precision), wind_data)
    train(whole, at)
    saved = frozen(whole.state())
    wanted = train(whole, STEPS - at)
    again = taped(config(method, precision), wind_data)
    # It has recorded steps before it is put back into the state.
    train(again, 6)
    again.load(saved)
    assert train(again, STEPS - at) == wanted
    assert_same(again.state(), whole.state())


def test_metrics_are_not_written_over(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_cuda(monkeypatch)
    plain, learner = Learner(config("ctmrl"), wind_data), taped(config("ctmrl"), wind_data)
    rows = [list(meta_train(one, 5, lambda: None, 5)) for one in (plain, learner)]
    assert rows[0] == rows[1]
    assert len(rows[0]) == STEPS // 5


def test_a_recorded_run_that_diverges_is_explained(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_cuda(monkeypatch)
    found = []
    for make in (Learner, taped):
        learner = make(config("focal"), wind_data)
        train(learner, 6)
        with torch.no_grad():
            next(learner.actor_critic.actor.net.parameters()).fill_(torch.inf)
        with pytest.raises(Diverged) as caught:
            list(meta_train(learner, 5, lambda: None, 5))
        found.append(str(caught.value))
    assert found[0] == found[1]
    assert "at step 7" in found[0]


@every_case
def test_nothing_moves(
    method: str, precision: str, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_cuda(monkeypatch)
    learner = taped(config(method, precision), wind_data)
    train(learner, 11)

    def places() -> dict[str, int]:
        state = learner.state()
        names = state.keys() - {"step", "generator"}
        rates = {
            f"rate/{name}/{index}": group["lr"]
            for name, optimizer in learner.optimizers.items()
            for index, group in enumerate(optimizer.param_groups)
        }
        return {name: state[name].data_ptr() for name in names} | {
            name: rate.data_ptr() for name, rate in rates.items()
        }

    before = places()
    assert len(before) > 50
    train(learner, STEPS - 11)
    assert places() == before


def place(learner: Learner, placed: bool) -> None:
    """Say whether a method's codes are in use, which is said on the host."""
    if isinstance(codebook := getattr(learner.method, "codebook", None), nn.Module):
        assert isinstance(codebook.placed, Tensor)
        assert codebook.placed.device.type == "cpu"
        codebook.placed.fill_(placed)


def given(learner: Learner) -> Given:
    tasks = learner._draw_tasks(learner.generator)
    return Given(
        learner._draw(tasks, learner.method.context_sets),
        learner.data.transitions(tasks, learner._rows_a_task, learner.generator),
        learner.data.params[tasks],
    )


@every_case
@pytest.mark.parametrize("placed", [False, True])
def test_a_step_does_the_same_operations_each_time_and_draws_nothing(
    placed: bool, method: str, precision: str, wind_data: OfflineData
) -> None:
    learner, taken = Learner(config(method, precision), wind_data), list[list[Any]]()
    place(learner, placed)
    source = NumbersAhead(learner.generator, learner.device)
    learner._step(given(learner), source)
    for _ in range(2):
        inputs = given(learner)
        source.draw()
        source.rewind()
        with Tape() as tape:
            learner._step(inputs, source)
        taken.append([func for func, *_ in tape.calls])
        learner.update()
    assert taken[0] == taken[1]
    assert len(taken[0]) > 200
    assert not any(torch.Tag.nondeterministic_seeded in func.tags for func in taken[0])


def test_a_draw_in_a_step_would_be_seen() -> None:
    with Tape() as tape:
        torch.rand(3, generator=generator())
    assert any(torch.Tag.nondeterministic_seeded in func.tags for func, *_ in tape.calls)


class OnMeta(Numbers):
    """Random numbers without values."""

    def take(self, kind: Kind, shape: tuple[int, ...]) -> Tensor:
        return torch.empty(shape, device=META)


class Devices(TorchDispatchMode):  # type: ignore[no-untyped-call] # torch's own
    """Notes where the tensors of operations are, but for scalars."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call] # torch's own
        self.seen: set[torch.device] = set()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        tensors = (one for one in tree_leaves((args, kwargs, out)) if isinstance(one, Tensor))
        self.seen |= {one.device for one in tensors if one.ndim}
        return out


@every_case
@pytest.mark.parametrize("placed", [False, True])
def test_a_step_waits_for_no_value_and_is_on_its_device_alone(
    placed: bool, method: str, precision: str
) -> None:
    """Tensors of torch's meta device have no values, and do not mix with those of the host."""
    dataset = synthetic_dataset("point_robot_wind", episodes=4)
    learner = Learner(config(method, precision), OfflineData(dataset, dataset.train_tasks))
    learner.data.to(META)
    learner.method.to(META)
    learner.actor_critic.to(META)
    learner.device, learner._numbers = META, Numbers(learner.generator, META)
    place(learner, placed)
    inputs = given(learner)
    with Devices() as devices:
        metrics, made = learner._step(inputs, OnMeta(learner.generator, META))
    assert devices.seen == {META}
    assert learner.all_contexts().device == META
    assert {value.device for value in (metrics | made).values()} == {META}
    reached = [one for one in learner.actor_critic.parameters() if one.grad is not None]
    assert reached
    assert {one.grad.device for one in reached if one.grad is not None} == {META}


@pytest.mark.parametrize(
    "ask", [lambda x: x.sum().item(), lambda x: x + torch.ones(3), lambda x: bool(x[0] > 0)]
)
def test_asking_for_a_value_or_mixing_devices_would_be_seen(ask: Any) -> None:
    with pytest.raises((RuntimeError, NotImplementedError), match="meta"):
        ask(torch.ones(3, device=META))


def test_data_on_a_device(wind_path: Path, tmp_path: Path, wind_data: OfflineData) -> None:
    dataset = open_dataset(wind_path)
    for room, where in ((Room(1.0), META), (Room(0.0, tmp_path), torch.device("cpu"))):
        data = OfflineData(dataset, dataset.train_tasks, room=room)
        assert data.device.type == "cpu"
        data.to(META)
        assert (data.device, data.params.device, data.table.device) == (META, META, where)
        draw = torch.Generator().manual_seed(5)
        tasks = torch.arange(3)
        assert data.contexts(tasks, 2, 1, 4, draw).device == META
        assert {one.device for one in data.transitions(tasks, 4, draw)} == {META}
        # The host's generator was asked for the same.
        same = torch.Generator().manual_seed(5)
        wind_data.contexts(tasks, 2, 1, 4, same)
        wind_data.transitions(tasks, 4, same)
        assert draw.get_state().equal(same.get_state())


def test_a_table_that_the_device_has_no_room_for_is_one_sentence(
    wind_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = open_dataset(wind_path)
    data = OfflineData(dataset, dataset.train_tasks)

    def full(*about: Any) -> Tensor:
        raise torch.OutOfMemoryError

    data.params = torch.zeros(1)
    monkeypatch.setattr(Tensor, "to", lambda one, *rest: one if one.numel() == 1 else full())
    with pytest.raises(UsageError, match=r"take 0\.00 GB as a table, more than meta has: --memory"):
        data.to(META)


def test_the_agent_of_a_gpu_is_a_copy_on_the_host(wind_data: OfflineData) -> None:
    learner = Learner(config("ctmrl"), wind_data)
    assert learner.agent.actor is learner.actor_critic.actor
    learner.device = torch.device("cuda")
    agent = learner.agent
    pairs = zip(
        (*agent.method.state_dict().values(), *agent.actor.state_dict().values()),
        (*learner.method.state_dict().values(), *learner.actor_critic.actor.state_dict().values()),
        strict=True,
    )
    for one, other in pairs:
        assert one.equal(other)
        assert one.data_ptr() != other.data_ptr()


def test_the_kind_of_device_is_a_setting(wind_path: Path) -> None:
    dataset = open_dataset(wind_path)
    split = split_tasks(dataset, False)
    for name, kind in (("cuda:1", "cuda"), ("cuda", "cuda")):
        made = dataclasses.replace(config("focal"), device=name)
        assert known_settings(made, dataset, split)["settings"]["device"] == kind
    assert "device" not in known_settings(config("focal"), dataset, split)["settings"]


@pytest.mark.parametrize("device", ["nonsense", "cuda:99", "meta", ""])
def test_a_device_that_is_not_there_is_one_sentence(
    device: str, wind_path: Path, wind_data: OfflineData
) -> None:
    made = dataclasses.replace(config("focal"), device=device, data=wind_path)
    for refused in (lambda: check(made), lambda: Learner(made, wind_data)):
        with pytest.raises(UsageError, match=f"--device {device} cannot be used here: ") as caught:
            refused()
        assert "\n" not in str(caught.value)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@every_case
def test_a_gpu_learns_as_a_processor_does(method: str, precision: str) -> None:
    dataset = synthetic_dataset("point_robot_wind", episodes=4)
    found: list[tuple[list[dict[str, float]], dict[str, Tensor]]] = []
    for device in ("cpu", "cuda", "cuda"):
        made = dataclasses.replace(config(method, precision), device=device)
        learner = Learner(made, OfflineData(dataset, dataset.train_tasks))
        begin = frozen(learner.state())
        half = STEPS // 2
        rows = train(learner, half)
        if len(found) == 2:
            saved = {name: value.cpu() for name, value in frozen(learner.state()).items()}
            learner = Learner(made, OfflineData(dataset, dataset.train_tasks))
            learner.load(saved)
        rows += train(learner, STEPS - half)
        found.append((rows, {name: x.cpu() for name, x in learner.state().items()}))
    # The same bytes, whether or not it was interrupted.
    assert found[1][0] == found[2][0]
    assert_same(found[1][1], found[2][1])
    bound = 0.02 if precision == "float32" else 0.2
    for name, value in found[0][1].items():
        if name.endswith("weight") or ".weights." in name:
            moved = torch.linalg.norm(value - begin[name].cpu())
            assert torch.linalg.norm(found[1][1][name] - value) < bound * moved + 1e-6, name
