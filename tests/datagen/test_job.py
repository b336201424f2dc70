"""What a job draws its random numbers from, and what its data say of where they come from."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib import metadata
from pathlib import Path

from datagen.budgets import budget
from datagen.job import Job, Stream, group_file, versions

JOB = Job("sparse_point_robot", 2, budget("sparse_point_robot", "smoke"), 7, Path())


def test_no_two_streams_are_the_same() -> None:
    jobs = [replace(JOB, seed=seed, task=task) for seed in range(3) for task in range(3)]
    states = [
        tuple(job.stream(purpose, checkpoint).generate_state(4).tolist())
        for job in jobs
        for purpose in Stream
        for checkpoint in (0, 80, 100)
    ]
    assert len(set(states)) == len(states)


def test_every_group_has_a_file_of_its_own() -> None:
    groups = [(0,), (0, 1), (0, 2), (1, 2), (0, 1, 2), tuple(range(30))]
    paths = {group_file(Path("folder"), group) for group in groups}
    assert len(paths) == len(groups)
    assert {path.parent for path in paths} == {Path("folder")}
    assert all(path.name.startswith(".") for path in paths)


def test_versions_are_those_installed() -> None:
    found = versions()
    assert found["python"] == sys.version.split()[0]
    assert found["stable_baselines3"] == metadata.version("stable-baselines3")
    assert found["torch"] == metadata.version("torch").split("+")[0]
    assert {"numpy", "gymnasium", "h5py", "mujoco"} < set(found)
