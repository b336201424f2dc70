"""Gradient steps in bfloat16: what of them is, how near they are to float32's, what is stored."""

from __future__ import annotations

import dataclasses
import io
import re
import signal
from collections import Counter
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from rich.console import Console
from torch import Tensor
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from ctmrl import networks
from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.networks import Critic, mlp
from ctmrl.precision import Precision, lowered, products_in
from ctmrl.presets import config_from_settings, preset
from ctmrl.runs import load_checkpoint, read_json
from ctmrl.synthetic import synthetic_dataset
from ctmrl.train import train
from tests.ctmrl.commands import Commands, contents, rows, wait_until
from tests.ctmrl.examples import OBS, Z, normal, smoke, statistics

LOW = torch.bfloat16
COMPUTE = ("addmm", "mm", "baddbmm", "bmm", "relu_", "threshold_backward", "sum", "add", "add_")
"""Layers, and the sums of their gradients over rows and blocks."""
MOVE = (
    *("_to_copy", "as_strided", "cat", "clone", "copy_", "detach", "expand", "new_empty_strided"),
    *("new_zeros", "select", "select_backward", "slice", "slice_backward", "split", "squeeze"),
    *("t", "transpose", "unsqueeze", "view", "_unsafe_view"),
)


@pytest.fixture(autouse=True)
def blocks_of_500_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer than the contexts and the actor's batches have, so that all networks have blocks."""
    monkeypatch.setattr(networks, "MLP_BLOCK", 500)


@pytest.fixture(scope="module")
def cheetah_data() -> OfflineData:
    """Random numbers in the shape of HalfCheetahVel's data."""
    dataset = synthetic_dataset("half_cheetah_vel", episodes=4)
    return OfflineData(dataset, dataset.train_tasks)


def cheetah(method: str, precision: Precision) -> RunConfig:
    """The field's settings with networks of its depth, but narrow, and contexts that are short.

    A batch of 1,280 transitions is more than critics evaluate at once.
    """
    config = preset("half_cheetah_vel", method, "paper", precision=precision)
    narrow = {"encoder_hidden": (32,) * 3, "predictor_hidden": (32,) * 3}
    known = {field.name for field in dataclasses.fields(config.context)}
    changes: dict[str, Any] = {key: value for key, value in narrow.items() if key in known}
    return dataclasses.replace(
        config,
        context=dataclasses.replace(config.context, **changes),
        actor_critic=dataclasses.replace(config.actor_critic, hidden=(32,) * 3),
        training=dataclasses.replace(
            config.training, batch_size=80, context_size=32, context_episodes=2
        ),
    )


def begun(method: str, precision: Precision, data: OfflineData) -> Learner:
    """A learner before its first step, its codebook in use."""
    learner = Learner(cheetah(method, precision), data)
    if isinstance(codebook := getattr(learner.method, "codebook", None), torch.nn.Module):
        codebook.placed.fill_(True)  # type: ignore[operator]
    return learner


def parameters(learner: Learner) -> dict[str, Tensor]:
    owners = (("method", learner.method), ("actor_critic", learner.actor_critic))
    return {f"{o}.{n}": p for o, module in owners for n, p in module.named_parameters()}


class Watch(TorchDispatchMode):  # type: ignore[no-untyped-call] # torch's own
    """Notes which operations see bfloat16, and which memory is cast to it."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call] # torch's own
        self.names: set[str] = set()
        self.cast: Counter[int] = Counter()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        tensors = [one for one in tree_leaves((args, kwargs)) if isinstance(one, Tensor)]
        if func is torch.ops.aten._to_copy.default and out.dtype == LOW:
            self.cast[tensors[0].data_ptr()] += 1
        elif any(one.dtype == LOW for one in tensors):
            self.names.add(func.overloadpacket.__name__)
        return out


def test_a_network_computes_in_bfloat16_and_gives_what_it_is_given() -> None:
    x = normal(19, OBS).float()
    net, critic = mlp(OBS, (23, 29), 5), Critic(statistics().obs, Z, (23, 29), heads=2)
    z = normal(19, Z, seed=1).float()
    plain = (net(x), critic(x, z))
    with products_in("float32"):
        assert net(x).equal(plain[0])
        assert lowered(x) is x
    with products_in("bfloat16"):
        low = (net(x), critic(x, z))
        with products_in("float32"):
            assert critic(x, z).equal(plain[1])
        assert lowered(x).dtype == LOW
    with pytest.raises(KeyError), products_in("bfloat16"):
        raise KeyError
    assert net(x).equal(plain[0])
    # A result of bfloat16 has 8 bits, and its float32 no more; a critic's last layer is float32.
    assert low[0].equal(low[0].to(LOW).float())
    assert not low[1].equal(low[1].to(LOW).float())
    for found, wanted in zip(low, plain, strict=True):
        assert found.dtype == torch.float32
        assert not found.equal(wanted)
        torch.testing.assert_close(found, wanted, rtol=0.03, atol=0.03)


def test_a_critic_far_from_zero_tells_actions_apart() -> None:
    x, z = normal(64, OBS).float(), normal(64, Z, seed=1).float()
    critic = Critic(statistics().obs, Z, (32, 32), heads=2)
    near = critic(x, z)
    critic.shift(-150.0)
    with products_in("bfloat16"):
        far = critic(x, z) + 150.0
    assert near.std() > 0.05
    # In bfloat16 the steps between numbers are 1 there.
    torch.testing.assert_close(far, near, rtol=0, atol=0.02)


def test_gradients_of_a_critic_far_from_zero_are_near_those_of_float32() -> None:
    x, z = normal(64, OBS).float(), normal(64, Z, seed=1).float()
    critic = Critic(statistics().obs, Z, (32, 32), heads=2)
    critic.shift(-150.0)
    target = critic(x, z).detach() + 0.1 * normal(2, 64, seed=2).float()
    found: dict[Precision, Tensor] = {}
    for precision in get_args(Precision):
        with products_in(precision):
            loss = (critic(x, z) - target).square().mean()
        gradients = torch.autograd.grad(loss, [*critic.parameters()])
        found[precision] = torch.cat([one.flatten() for one in gradients])
    assert (found["bfloat16"] - found["float32"]).norm() < 0.1 * found["float32"].norm()


def test_layers_that_are_shared_and_frozen_ones() -> None:
    x, z = normal(19, OBS).float(), normal(19, Z, seed=1).float()
    critic = Critic(statistics().obs, Z, (23, 29), heads=2)
    for precision in ("float32", "bfloat16"):
        with products_in(precision):
            layers, alone = critic.layers(), critic(x, z)
            given = z.clone().requires_grad_()
            assert critic(x, z, layers=layers).equal(alone)
            still = critic(x, given, layers=networks.frozen(layers))
        assert still.equal(alone)
        still.sum().backward()
        assert given.grad is not None
        assert given.grad.any()
        assert all(parameter.grad is None for parameter in critic.parameters())


@pytest.mark.parametrize("method", METHODS)
def test_nothing_but_layers_is_in_bfloat16(method: str, cheetah_data: OfflineData) -> None:
    learner = begun(method, "bfloat16", cheetah_data)
    with Watch() as watch:
        metrics = learner.update()
    assert {"addmm", "baddbmm", "bmm", "relu_", "threshold_backward"} <= watch.names
    assert watch.names <= {*COMPUTE, *MOVE}
    assert all(value.dtype == torch.float32 for value in metrics.values())
    assert not any(value.dtype == LOW for value in learner.state().values())
    assert not any(p.grad is not None and p.grad.dtype == LOW for p in parameters(learner).values())


@pytest.mark.parametrize("method", METHODS)
def test_a_weight_is_cast_once_for_a_call_and_critics_calls_share(
    method: str, cheetah_data: OfflineData
) -> None:
    learner, places = begun(method, "bfloat16", cheetah_data), dict[int, str]()
    for name, parameter in parameters(learner).items():
        places[parameter.data_ptr()] = name
    with Watch() as watch:
        learner.update()
    found = {name: watch.cast[place] for place, name in places.items()}
    for name, times in found.items():
        wanted = 1
        if name.endswith((".weights.3", ".biases.3")):
            wanted = 0  # a critic's last layer
        elif "dual_critic" in name:
            wanted = 4  # before each of its three steps and after them
        elif ".actor." in name:
            wanted = 2  # with its gradient, and without it at all further batches
        elif "codebook" in name:
            wanted = 0
        elif method == "ctmrl_released" and ("encoder" in name or "predictors" in name):
            # For the contexts and for the cycle, which predicts once more.
            wanted = 2
        assert times == wanted, name


@pytest.mark.parametrize("method", METHODS)
def test_gradients_and_losses_are_near_those_of_float32(
    method: str, cheetah_data: OfflineData
) -> None:
    found: dict[str, dict[str, Tensor]] = {}
    metrics: dict[str, dict[str, Tensor]] = {}
    for precision in ("float32", "bfloat16"):
        learner = begun(method, precision, cheetah_data)
        metrics[precision] = learner.update()
        found[precision] = {
            name: parameter.grad
            for name, parameter in parameters(learner).items()
            if parameter.grad is not None
        }
    # FOCAL's distances stay when all encodings move alike: this gradient is a sum that cancels.
    found["float32"].pop("method.encoder.net.6.bias" if method == "focal" else "", None)
    assert len(found["float32"]) > 20
    assert not all(one.equal(found["bfloat16"][name]) for name, one in found["float32"].items())
    for name, wanted in found["float32"].items():
        near = found["bfloat16"][name]
        assert functional.cosine_similarity(near.flatten(), wanted.flatten(), dim=0) > 0.99, name
        assert 0.95 < near.norm() / wanted.norm() < 1.05, name
    for name, value in metrics["float32"].items():
        torch.testing.assert_close(metrics["bfloat16"][name], value, rtol=0.02, atol=2e-3)


def test_contexts_for_k_means_and_measured_returns_are_in_float32(
    cheetah_data: OfflineData,
) -> None:
    learner = begun("ctmrl", "bfloat16", cheetah_data)
    with Watch() as watch:
        learner.all_contexts()
    assert not watch.cast
    learner.update()
    contexts = cheetah_data.contexts(torch.arange(3), 1, 2, 7, learner.generator)
    with Watch() as watch:
        learner.agent.method.encoder(contexts)
        learner.agent.actor.act(torch.zeros(3, 20), torch.zeros(3, 20))
    assert not watch.cast


def run(config: RunConfig, **changes: Any) -> dict[str, Any]:
    """Train in this process; what config.json holds."""
    changed = dataclasses.replace(config, **changes)
    train(changed, Console(file=io.StringIO(), width=200))
    assert changed.out is not None
    return read_json(changed.out / "config.json")


def best_is(precision: Precision, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this a machine of that best precision."""
    monkeypatch.setattr("datagen.accelerator.best_precision", lambda *device: precision)


def test_a_run_stores_its_precision_and_goes_on_in_it_elsewhere(
    wind_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, path = smoke(3, data=wind_path, precision="auto"), tmp_path / "run"
    best_is("bfloat16", monkeypatch)
    stored = run(config, out=path)
    assert stored["settings"]["precision"] == "bfloat16"
    assert config_from_settings(stored, path).precision == "bfloat16"
    before = contents(path)
    # As if it had been interrupted, and went on where float32 is the best.
    best_is("float32", monkeypatch)
    for name in ("evaluation.json", "adaptation.png", "contexts.png"):
        (path / name).unlink()
    run(config, out=path)
    assert contents(path) == before
    said = re.escape("settings.precision = bfloat16, this one has float32: choose another --out")
    with pytest.raises(UsageError, match=said):
        run(config, out=path, precision="float32")
    # Begun anew it is this machine's.
    assert "precision" not in run(config, out=path, restart=True)["settings"]
    plain = run(config, out=tmp_path / "float32", precision="float32")
    assert contents(tmp_path / "float32") == contents(path)
    assert "precision" not in plain["settings"]
    key = "actor_critic/actor.net.0.weight"
    assert not load_checkpoint(path / "checkpoint.pt")[key].equal(
        torch.load(io.BytesIO(before["checkpoint.pt"]), weights_only=True)[key]
    )


def test_a_run_from_before_there_was_a_choice_stays_in_float32(
    wind_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run"
    run(smoke(3, data=wind_path), out=path)
    before = contents(path)
    best_is("bfloat16", monkeypatch)
    run(smoke(3, data=wind_path, precision="auto"), out=path)
    assert contents(path) == before
    with pytest.raises(UsageError, match=r"settings\.precision = float32, this one has bfloat16"):
        run(smoke(3, data=wind_path, precision="bfloat16"), out=path)
    # A robot's default is "auto", which is not what such a run has.
    stored = read_json(path / "config.json")
    stored["settings"]["env"] = "half_cheetah_vel"
    assert config_from_settings(stored, path).precision == "float32"


def test_a_folder_of_something_else_says_nothing_of_a_precision(tmp_path: Path) -> None:
    config = smoke(3, data=None, precision="auto")
    for text in ('{"compilerOptions": {}}', '{"settings": []}'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(UsageError, match="holds a run with"):
            run(config, out=tmp_path)
        assert (tmp_path / "config.json").read_text() == text


@pytest.mark.parametrize("env", ["point_robot_wind", "hopper_params"])
@pytest.mark.parametrize("name", ["standard", "paper", "smoke"])
def test_the_defaults(env: str, name: Any) -> None:
    wanted = "auto" if env == "hopper_params" else "float32"
    assert preset(env, "focal", name).precision == wanted


def test_a_killed_run_in_bfloat16_ends_in_the_same_bytes(
    commands: Commands, wind_path: Path, tmp_path: Path
) -> None:
    sizes = ("--preset", "smoke", "--steps", "40", "--data", str(wind_path))
    words = ("ctmrl.train", *sizes, "--precision", "bfloat16", "--out")
    assert commands.run(*words, str(tmp_path / "whole")) == 0, commands.output()
    path = tmp_path / "run"
    commands.start(*words, str(path))
    wait_until(lambda: rows(path / "metrics.csv") > 5)
    commands.send(signal.SIGKILL)
    assert commands.wait() == -signal.SIGKILL
    assert commands.run(*words, str(path)) == 0, commands.output()
    assert commands.output().startswith("Going on at step ")
    assert contents(path) == contents(tmp_path / "whole")
