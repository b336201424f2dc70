"""A Ray of one process for tests: tasks run when they are waited for, and die as they are told."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import pytest


class RayError(Exception):
    pass


class RayTaskError(RayError):
    pass


class WorkerCrashedError(RayError):
    pass


class NodeDiedError(RayError):
    pass


class OutOfMemoryError(RayError):
    pass


class RuntimeEnvSetupError(RayError):
    pass


class Refusal(BaseException):
    """Raised by a job that Ray never starts."""


class Death(BaseException):
    """Raised by a job whose process dies."""


@dataclass(eq=False)
class Ref:
    """A result to come."""

    call: Callable[[], Any]
    retries: int = 0
    value: Any = None
    error: Exception | None = None

    def run(self) -> None:
        for _ in range(self.retries + 1):
            try:
                self.value = self.call()
            except Death:
                continue
            except Refusal:
                self.error = RuntimeEnvSetupError("no room\nand a long text")
            except Exception as error:
                self.error = RayTaskError(f"a long text\n{error!r}")
            return
        self.error = WorkerCrashedError("another long text")


@dataclass
class FakeRay:
    """What `datagen.ray_jobs` uses of Ray, and a record of what was done with it."""

    refuse: Exception | None = None
    init_options: dict[str, Any] = field(default_factory=dict)
    task_options: list[dict[str, Any]] = field(default_factory=list)
    cancelled: list[Ref] = field(default_factory=list)
    at_once: int = 0
    killed: int = 0
    connections: int = 0

    def init(self, **options: Any) -> None:
        if self.refuse:
            raise self.refuse
        self.init_options = options
        self.connections += 1

    def shutdown(self) -> None:
        self.connections -= 1

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        def wrap(target: Any) -> Any:
            if isinstance(target, type):
                return Remote(lambda: _Actor(target()))
            self.task_options.append(options)
            retries = options["max_retries"]
            return Remote(lambda *arguments: Ref(lambda: target(*arguments), retries))

        return wrap

    def wait(self, refs: list[Ref], timeout: float, num_returns: int = 1) -> tuple[list[Ref], None]:
        self.at_once = max(self.at_once, len(refs))
        refs[-1].run()
        return [refs[-1]], None

    def get(self, ref: Any) -> Any:
        if not isinstance(ref, Ref):
            return ref
        if ref.error:
            raise ref.error
        return ref.value

    def cancel(self, ref: Ref, force: bool) -> None:
        assert force
        self.cancelled.append(ref)

    def kill(self, actor: _Actor) -> None:
        self.killed += 1


@dataclass
class Remote:
    remote: Callable[..., Any]


class _Actor:
    """Methods of an object, each with a `remote` that calls it at once."""

    def __init__(self, target: Any) -> None:
        self.target = target

    def __getattr__(self, name: str) -> Remote:
        return Remote(getattr(self.target, name))


def install(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    """Put a fake in Ray's place."""
    fake, module = FakeRay(), ModuleType("ray")
    for name in ("init", "shutdown", "remote", "wait", "get", "cancel", "kill"):
        setattr(module, name, getattr(fake, name))
    errors = ModuleType("ray.exceptions")
    for error in (RayError, RayTaskError, WorkerCrashedError, NodeDiedError, OutOfMemoryError):
        setattr(errors, error.__name__, error)
    module.exceptions = errors  # type: ignore[attr-defined]  # it is a module for a test
    monkeypatch.setitem(sys.modules, "ray", module)
    return fake
