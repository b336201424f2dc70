"""The file of a fleet's training: whole, checked, without a pickle, and all a learner is."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from datagen.files import DatasetError
from datagen.fleet.state import (
    group_of,
    learner_counts,
    learner_tensors,
    load_state,
    restore,
    save_state,
)
from tests.datagen.fleet.fleets import NEVER, SETTINGS, fleet, parameters

ABOUT = {"checkpoint": 40, "origin": {"gamma": 0.97, "name": "ä"}, "state": [2**127 + 1, True]}


def tensors() -> dict[str, Tensor]:
    drawn = np.random.default_rng(0).standard_normal((6, 5), dtype=np.float32)
    values = torch.from_numpy(drawn)
    # Parts of one memory, one of them turned, a scalar and an empty one.
    return {
        "b": values[:3],
        "a.1": values[3:].T,
        "step": torch.tensor(4.0),
        "none": torch.zeros(0, 3),
        "learnt": torch.ones(2, requires_grad=True),
    }


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "state"
    save_state(path, tensors(), ABOUT)
    held, about = load_state(path)
    assert about == ABOUT
    assert held.keys() == tensors().keys()
    for name, value in tensors().items():
        assert torch.equal(held[name], value.detach()), name
    assert [one.name for one in tmp_path.iterdir()] == ["state"]


def test_the_same_state_has_the_same_bytes(tmp_path: Path) -> None:
    backwards = dict(reversed(list(ABOUT.items())))
    save_state(tmp_path / "one", tensors(), ABOUT)
    save_state(tmp_path / "other", dict(reversed(list(tensors().items()))), backwards)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_it_is_no_pickle(tmp_path: Path) -> None:
    save_state(tmp_path / "state", tensors(), ABOUT)
    content = (tmp_path / "state").read_bytes()
    size = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + size])
    assert head["b"]["dtype"] == "F32"
    begin, end = head["b"]["data_offsets"]
    body = content[8 + size :]
    assert body[begin:end] == tensors()["b"].numpy().tobytes()
    assert len(body) == 4 * (6 * 5 + 1 + 0 + 2)
    with pytest.raises(Exception, match=r"[Pp]ickle|[Uu]npickl|weights"):
        torch.load(tmp_path / "state", weights_only=True)


def test_a_flipped_byte_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "state"
    save_state(path, tensors(), ABOUT)
    whole = path.read_bytes()
    # Of the header's length, the header, the hash in it, and the values.
    places = [(place, 0x01) for place in range(0, len(whole), 3)]
    places += [(place, 0xFF) for place in range(0, len(whole), 10)]
    for place, flip in places:
        damaged = bytearray(whole)
        damaged[place] ^= flip
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"^is damaged") as caught:
            load_state(path)
        assert "\n" not in str(caught.value)


def test_a_truncated_file_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "state"
    save_state(path, tensors(), ABOUT)
    whole = path.read_bytes()
    for size in (0, 1, 7, 8, 9, 100, len(whole) - 100, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"^is damaged"):
            load_state(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(ValueError, match=r"^is damaged"):
        load_state(path)


@pytest.mark.parametrize(
    "metadata",
    [None, {}, {"other": "{}"}, {"fleet": "[]"}, {"fleet": "{}"}, {"fleet": "\ud7ff"}],
)
def test_somebody_elses_tensors(metadata: dict[str, str] | None, tmp_path: Path) -> None:
    save_file({"a": torch.zeros(2)}, tmp_path / "state", metadata)
    with pytest.raises(ValueError, match=r"^is damaged"):
        load_state(tmp_path / "state")


def test_what_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="cannot be read"):
        load_state(tmp_path / "absent")
    with pytest.raises(DatasetError, match="cannot be read"):
        load_state(tmp_path)


def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    save_state(path, tensors(), ABOUT)
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match=r"cannot be written|File too large"):
            save_state(path, {"a": torch.zeros(100_000)}, ABOUT)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [one.name for one in tmp_path.iterdir()] == ["state"]
    assert path.read_bytes() == before
    with pytest.raises(OSError, match="cannot be written"):
        save_state(tmp_path / "absent" / "state", tensors(), ABOUT)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_learner_goes_on_as_if_nothing_had_been(precision: Any, tmp_path: Path) -> None:
    model = fleet((0, 1), precision=precision)
    model.learn(60 * 2, log_interval=NEVER)
    save_state(tmp_path / "state", learner_tensors(model), learner_counts(model))
    again = fleet((0, 1), precision=precision)
    restore(again, *load_state(tmp_path / "state"))
    for one in (model, again):
        assert (one.num_timesteps, one._n_updates, one.replay_buffer.pos) == (120, 20, 60)
        one.train(7, SETTINGS.batch_size)
        assert one.policy.noise(3).shape == (2, 3, 3)
    for row in range(2):
        for name, value in parameters(model, row).items():
            np.testing.assert_array_equal(parameters(again, row)[name], value, err_msg=name)
    assert learner_counts(again) == learner_counts(model)
    for name, tensor in learner_tensors(model).items():
        assert torch.equal(learner_tensors(again)[name], tensor), name


def test_the_state_of_another_learner() -> None:
    model = fleet((0, 1))
    model.learn(50 * 2, log_interval=NEVER)
    held, counts = learner_tensors(model), learner_counts(model)
    other: dict[str, tuple[dict[str, Tensor], dict[str, Any]]] = {
        "a weight is missing": ({k: v for k, v in held.items() if k[-9:] != "weights.0"}, counts),
        "no temperature": ({k: v for k, v in held.items() if k != "log_temperature"}, counts),
        "no memory": ({k: v for k, v in held.items() if k != "memory"}, counts),
        "a weight too many": ({**held, "policy.more": torch.zeros(1)}, counts),
        "another shape": ({**held, "policy.actor.weights.0": torch.zeros(2, 11, 9)}, counts),
        "another memory": ({**held, "memory": torch.zeros(5, 2, 9)}, counts),
        "a generator is missing": (held, {**counts, "generators": counts["generators"][:1]}),
        "no counts": (held, {}),
    }
    for some, said in other.values():
        again = fleet((0, 1))
        with pytest.raises(ValueError, match=r"^is of another learner \("):
            restore(again, some, said)


def test_the_group_is_read_without_the_tensors(tmp_path: Path) -> None:
    path = tmp_path / "state"
    save_state(path, tensors(), {"origin": {"group": [3, 4, 8]}})
    content = path.read_bytes()
    assert group_of(path) == (3, 4, 8)
    path.write_bytes(content[:100])
    assert group_of(path) == ()
    save_state(path, tensors(), {"origin": {}})
    assert group_of(path) == ()
    assert group_of(tmp_path / "none") == ()
