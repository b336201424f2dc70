"""The state of a fleet's training in one file of tensors and JSON, whole or absent."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from datagen.files import canonical_json, parse_canonical, partial_of, sync_folder, unreadable
from datagen.fleet.algorithm import FleetSAC

_ABOUT = "fleet"
"""The one key of the file's metadata; its value is JSON."""
_DIGEST = "content_sha256"
"""The key in there of the hash of everything else: the tensors' format has no checksum."""


def save_state(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write a file of tensors that is whole or absent, whatever happens in between.

    Raises:
        OSError: the disk is full or the folder is not there.
    """
    partial = partial_of(path)
    held = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        text = canonical_json({**about, _DIGEST: _digest(held, about)})
        save_file(held, partial, {_ABOUT: text})
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except SafetensorError as error:
        partial.unlink(missing_ok=True)
        raise OSError(f"{path} cannot be written ({error})") from error
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def load_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_state` has written.

    Raises:
        DatasetError: the system refuses to read it.
        ValueError: it is damaged, and how.
    """
    try:
        with safe_open(path, framework="pt") as file:
            about = parse_canonical((file.metadata() or {})[_ABOUT].encode())
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except OSError as error:
        raise unreadable(path, error) from error
    except (SafetensorError, KeyError, ValueError) as error:
        raise ValueError(f"is damaged ({error})") from error
    if about.pop(_DIGEST, None) != _digest(tensors, about):
        raise ValueError("is damaged (its values are not those it was written with)")
    return tensors, about


def group_of(path: Path) -> tuple[int, ...]:
    """The tasks of a group's file, without reading its tensors; none where it does not say."""
    try:
        with safe_open(path, framework="pt") as file:
            about = parse_canonical((file.metadata() or {})[_ABOUT].encode())
        return tuple(map(int, about["origin"]["group"]))
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return ()


def _digest(tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> str:
    """SHA-256 of tensors, which are the processor's, and of what is said about them."""
    total = hashlib.sha256(canonical_json(about).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return total.hexdigest()


def network_tensors(model: FleetSAC) -> dict[str, Tensor]:
    """All networks and temperatures."""
    networks = {f"policy.{name}": value for name, value in model.policy.state_dict().items()}
    return {**networks, "log_temperature": model.log_temperature.detach()}


def learner_tensors(model: FleetSAC) -> dict[str, Tensor]:
    """Everything a learner's next update depends on, but for its generators."""
    memory, tensors = model.replay_buffer, network_tensors(model)
    tensors["memory"] = torch.from_numpy(memory.rows[: memory.pos])
    for name, optimizer in model.optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            for key, value in state.items():
                tensors[f"{name}.{index}.{key}"] = value
    return tensors


def learner_counts(model: FleetSAC) -> dict[str, Any]:
    """The rest of a learner's state, as JSON values."""
    return {
        "timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "generators": [one.bit_generator.state for one in model.generators],
    }


def restore(model: FleetSAC, tensors: Mapping[str, Tensor], counts: Mapping[str, Any]) -> None:
    """Put a learner of the same tasks and settings back into a saved state.

    Raises:
        ValueError: something is missing or of another shape.
    """
    try:
        _restore(model, tensors, counts)
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"is of another learner ({error})") from error


def _restore(model: FleetSAC, tensors: Mapping[str, Tensor], counts: Mapping[str, Any]) -> None:
    prefix = "policy."
    weights = {name.removeprefix(prefix): tensors[name] for name in tensors if prefix in name}
    model.policy.load_state_dict(weights)
    model.policy.refresh()
    with torch.no_grad():
        model.log_temperature.copy_(tensors["log_temperature"])
    rows = tensors["memory"].numpy()
    model.replay_buffer.rows[: len(rows)] = rows
    model.replay_buffer.pos = len(rows)
    for name, optimizer in model.optimizers.items():
        held = optimizer.state_dict()
        held["state"] = _optimizer_state(name, tensors)
        optimizer.load_state_dict(held)
    model.record()
    model.num_timesteps, model._n_updates = counts["timesteps"], counts["updates"]
    for generator, state in zip(model.generators, counts["generators"], strict=True):
        generator.bit_generator.state = state


def _optimizer_state(name: str, tensors: Mapping[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    found: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        owner, _, rest = key.partition(".")
        if owner == name:
            index, _, part = rest.partition(".")
            found.setdefault(int(index), {})[part] = value
    return found
