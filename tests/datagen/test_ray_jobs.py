"""Jobs on Ray: news, failures, deaths and retries with a fake; the same bytes with Ray itself."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from datagen import ray_jobs
from datagen.collect import main
from datagen.ray_jobs import QUIET, RETRIES, connected, run_jobs
from datagen.workers import THREAD_VARIABLES, Event, Report, WorkerError
from tests.datagen.environments import other_environment
from tests.datagen.fake_ray import Death, FakeRay, Refusal, install

Capture = pytest.CaptureFixture[str]
SMOKE = ("--env", "point_robot_wind", "--budget", "smoke", "--tasks", "0-1")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    for name in QUIET:
        monkeypatch.setenv(name, "0")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return install(monkeypatch)


def square(job: int, report: Report) -> int:
    report(job)
    return job * job


def test_every_job_is_started_reports_and_is_done(fake: FakeRay) -> None:
    events = list(run_jobs(square, [3, 4, 5, 6, 7], 2))
    for index, job in enumerate([3, 4, 5, 6, 7]):
        assert [event for event in events if event.index == index] == [
            Event(index, "started"),
            Event(index, "step", job),
            Event(index, "done", job * job),
        ]
    assert len(events) == 15
    assert fake.at_once == 2
    assert fake.task_options == [{"num_cpus": 1, "num_gpus": 0, "max_retries": RETRIES}]
    assert (fake.killed, fake.cancelled) == (1, [])


def test_a_device_is_asked_for(fake: FakeRay) -> None:
    list(run_jobs(square, [3], 2, gpus=1))
    assert fake.task_options[0]["num_gpus"] == 1


def test_no_jobs_are_no_events(fake: FakeRay) -> None:
    assert list(run_jobs(square, [], 3)) == []


def test_a_job_whose_process_dies_is_begun_again(fake: FakeRay) -> None:
    deaths = iter(range(RETRIES))

    def dies(job: int, report: Report) -> int:
        report(job)
        for _ in deaths:
            raise Death
        return job

    events = list(run_jobs(dies, [7], 1))
    assert [event.kind for event in events] == ["started", *["step"] * (RETRIES + 1), "done"]
    assert events[-1].value == 7


def raises(error: BaseException) -> Callable[[int, Report], int]:
    def work(job: int, report: Report) -> int:
        if job:
            raise error
        return job

    return work


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), r"^\[Errno \d+\] No space left"),
        (ValueError("one sentence"), "^one sentence$"),
        (KeyError("x"), "(?s)^an error in the program.*Traceback.*KeyError"),
        (BrokenPipeError("it"), r"^Ray cannot run it \(BrokenPipeError\('it'\)\)$"),
        (Refusal(), r"^Ray cannot run it \(RuntimeEnvSetupError: no room\)$"),
        (Death(), rf"^its worker process died {RETRIES + 1} times \(WorkerCrashedError\), as happ"),
    ],
)
def test_a_failure_is_a_sentence_and_stops_the_others(
    error: BaseException, message: str, fake: FakeRay
) -> None:
    with pytest.raises(WorkerError, match=message) as caught:
        list(run_jobs(raises(error), [0, 0, 1], 3))
    assert caught.value.index == 2
    assert (len(fake.cancelled), fake.killed) == (3, 1)


def test_leaving_the_loop_stops_the_tasks(fake: FakeRay) -> None:
    with closing(run_jobs(square, [1, 2, 3], 2)) as events:
        next(events)
        assert fake.killed == 0
    assert (len(fake.cancelled), fake.killed) == (2, 1)


def test_a_machine_with_other_versions_is_named(
    fake: FakeRay, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = iter([{"python": "3", "torch": "2.9"}, {"python": "3", "torch": "2.8"}])
    monkeypatch.setattr(ray_jobs, "versions", lambda: next(found))
    with pytest.raises(WorkerError, match=r"a machine of the cluster has torch 2\.8, .* 2\.9: "):
        list(run_jobs(square, [1], 1))


def test_a_connection_is_quiet_has_one_thread_each_and_ends(fake: FakeRay) -> None:
    with connected("auto"):
        assert fake.connections == 1
        assert fake.init_options["address"] == "auto"
        assert fake.init_options["include_dashboard"] is False
        variables = fake.init_options["runtime_env"]["env_vars"]
        assert variables == dict.fromkeys(THREAD_VARIABLES, "1")
        assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert fake.connections == 0
    with pytest.raises(KeyError), connected("local"):
        raise KeyError
    assert fake.connections == 0


def unused_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("auto", "--ray auto cannot be connected to: no instance\n"),
        ("somewhere", "--ray takes auto, local or HOST:PORT, got 'somewhere'\n"),
        ("127.0.0.1:{}", "--ray 127.0.0.1:{}: nobody answers there ("),
        ("ray://127.0.0.1:{}", "--ray ray://127.0.0.1:{}: nobody answers there ("),
    ],
)
def test_an_address_without_a_cluster_is_one_sentence(
    address: str, sentence: str, fake: FakeRay, tmp_path: Path, capsys: Capture
) -> None:
    port = unused_port()
    fake.refuse = ConnectionError("no instance\nand advice")
    out = tmp_path / "new"
    assert main([*SMOKE, "--ray", address.format(port), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(sentence.format(port))
    assert said.count("\n") == 1
    assert not out.exists()


def test_without_ray_a_sentence_names_the_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Capture
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    out = tmp_path / "new"
    assert main([*SMOKE, "--ray", "auto", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("--ray needs the package ray (")
    assert said.endswith("): run `pip install 'ctmrl[ray]'`\n")
    assert not out.exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with Ray."""
    return other_environment(tmp_path_factory.mktemp("ray") / "venv", "ray>=2.40")


# Ctrl-C is ignored by programs that a shell starts in the background, and by their children.
PROGRAM = (
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from datagen.collect import main\n"
    "if __name__ == '__main__': sys.exit(main())"
)


@contextmanager
def collecting(python: Path, folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A collection at work on a Ray of its own, in a process group of its own."""
    words = [str(python), "-c", PROGRAM, *arguments, "--ray", "local", "--out", str(folder)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()
        wait_until(lambda: not processes(python))


def processes(python: Path, title: str = "") -> list[int]:
    """Ids of the processes that a Python's Ray has started, with a word in their command."""
    columns = ["-o", "pid=", "-o", "ppid=", "-o", "args="]
    listing = subprocess.run(["ps", "-Aww", *columns], capture_output=True, text=True, check=True)
    rows = [line.split(maxsplit=2) for line in listing.stdout.splitlines()]
    own = {row[0] for row in rows if str(python.parent) in row[-1]}
    return [int(row[0]) for row in rows if own & {row[0], row[1]} and title in row[-1]]


def wait_until(holds: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


HOPPERS = ("--env", "hopper_params", "--budget", "smoke", "--tasks", "0-2", "--fleet-size", "2")


@pytest.fixture(scope="module")
def hoppers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a collection without Ray, not to be written to."""
    folder = tmp_path_factory.mktemp("hoppers") / "data"
    assert main([*HOPPERS, "--workers", "1", "--out", str(folder)]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("dies", [False, True])
def test_fleets_on_ray_make_the_same_bytes(
    dies: bool, python: Path, hoppers: Path, tmp_path: Path
) -> None:
    with collecting(python, tmp_path, *HOPPERS) as process:
        if dies:
            wait_until(lambda: processes(python, "ray::_serve"))
            os.kill(processes(python, "ray::_serve")[0], signal.SIGKILL)
        _, said = process.communicate(timeout=300)
    assert (process.returncode, said) == (0, "")
    assert contents(tmp_path) == contents(hoppers)


@pytest.mark.slow
def test_tasks_on_ray_make_the_same_bytes(python: Path, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    arguments = (*SMOKE, "--engine", "sb3")
    assert main([*arguments, "--out", str(here)]) == 0
    with collecting(python, there, *arguments) as process:
        _, said = process.communicate(timeout=300)
    assert (process.returncode, said) == (0, "")
    assert contents(there) == contents(here)


@pytest.mark.slow
def test_ctrl_c_stops_what_ray_does(python: Path, hoppers: Path, tmp_path: Path) -> None:
    with collecting(python, tmp_path, *HOPPERS) as process:
        wait_until(lambda: processes(python, "ray::_serve"))
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == "stopped with 0 of 3 tasks done; the same command continues\n"
    assert not list(tmp_path.glob("*.h5")), "nothing goes on"
    with collecting(python, tmp_path, *HOPPERS) as process:
        process.communicate(timeout=300)
    assert contents(tmp_path) == contents(hoppers)
