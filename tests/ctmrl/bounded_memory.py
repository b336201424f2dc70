"""Run as a module by test_data_in_file.py: learn in a process that may not hold all its data."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_train import Learner
from ctmrl.table import Room
from ctmrl.threads import settle_threads
from datagen.dataset import open_dataset
from tests.ctmrl.examples import smoke

STEPS = 3


def learn(path: str, room: Room) -> OfflineData:
    """Take a few steps on a dataset."""
    dataset = open_dataset(path, verify=False)
    data = OfflineData(dataset, dataset.train_tasks, room=room)
    learner = Learner(smoke(STEPS), data)
    for _ in range(STEPS):
        learner.update()
    return data


def private_memory() -> int:
    """Bytes of this process's memory that no file stands behind."""
    fields = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(fields["VmData"].split()[0])


if __name__ == "__main__":
    small, large, folder, gigabytes, megabytes = sys.argv[1:]
    settle_threads(1)
    # What the program itself needs is had before the limit is set.
    learn(small, Room(0, Path(folder)))
    limit = private_memory() + int(megabytes) * 10**6
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    try:
        table = learn(large, Room(float(gigabytes), Path(folder))).table
        sys.stdout.write(f"{table.numel() * 4}")
    except UsageError as error:
        sys.stdout.write(f"{error}")
