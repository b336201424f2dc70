"""CLI: is this dataset, or this task's file, whole and as it was written?"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from datagen.dataset import (
    INDEX_FILE,
    Dataset,
    DatasetError,
    TaskData,
    open_dataset,
    read_task,
    task_of,
)
from datagen.job import STATE_FILES

BESIDE = frozenset({INDEX_FILE, "README.md", "LICENSE", ".gitattributes"})
"""What may lie in a dataset's folder besides the task files of its index."""


@dataclass(frozen=True)
class CheckConfig:
    """Check datasets: schema, hashes, finiteness, flags. Exit code 1 if anything is wrong."""

    paths: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="PATH [PATH ...]", help_behavior_hint=""),
    ]
    """Folders of datasets, or single task files (.h5)."""


@dataclass
class Findings:
    """What a check found, sentence by sentence, beside the counts of the intact tasks."""

    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    tasks: int = 0
    transitions: int = 0
    episodes: int = 0
    terminals: int = 0
    timeouts: int = 0
    bytes: int = 0

    def add(self, data: TaskData, size: int) -> None:
        """Count an intact task with a file of `size` bytes."""
        self.tasks += 1
        self.transitions += len(data)
        self.episodes += int(data.episode[-1]) + 1
        self.terminals += int(data.terminals.sum())
        self.timeouts += int(data.timeouts.sum())
        self.bytes += size

    def counts(self) -> str:
        """The counts, for people."""
        return (
            f"{self.transitions:,} transitions in {self.episodes:,} episodes "
            f"({self.terminals:,} end in a terminal, {self.timeouts:,} in a timeout), "
            f"{self.bytes:,} bytes"
        )


def check_file(path: Path, findings: Findings) -> TaskData | None:
    """Check one task's file by what it says itself; None if it is at fault."""
    try:
        data = read_task(path)
    except DatasetError as error:
        findings.faults.append(str(error))
        return None
    findings.add(data, path.stat().st_size)
    return data


def check_folder(folder: Path, findings: Findings) -> Dataset | None:
    """Check the index of a dataset and all of its files, also if some are at fault.

    Returns:
        The dataset; None if its index is at fault, in which case every file is checked by itself.
    """
    try:
        dataset = open_dataset(folder, verify=False)
    except DatasetError as error:
        findings.faults.append(str(error))
        for name in _names(folder):
            if task_of(folder / name) is not None:
                check_file(folder / name, findings)
        return None
    for task in dataset.tasks.tolist():
        try:
            findings.add(dataset.read(task), dataset.entry(task)["bytes"])
        except DatasetError as error:
            findings.faults.append(str(error))
    findings.warnings.extend(_strays(folder, dataset))
    return dataset


def _names(folder: Path) -> list[str]:
    """Everything in a folder, sorted; nothing if the system refuses to list it."""
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []


def _strays(folder: Path, dataset: Dataset) -> Iterator[str]:
    """A sentence for everything in the folder that is no part of the dataset."""
    known = BESIDE | {record["file"] for record in dataset.index["tasks"]}
    for name in _names(folder):
        path = folder / name
        if name in known:
            continue
        if name.startswith(".") and name.endswith(".partial"):
            yield f"{path}: left by an interrupted writer; delete it if none is at work"
        elif path.match(STATE_FILES):
            yield f"{path}: an unfinished training of a fleet; finish the collection or delete it"
        elif task_of(path) is not None:
            yield f"{path}: no task of {INDEX_FILE}; finish the collection or delete it"
        else:
            yield f"{path}: no part of the dataset"


def check(path: Path) -> tuple[Findings, str]:
    """Check a dataset's folder or a task's file.

    Returns:
        The findings, and the line that says so if there is no fault.
    """
    findings = Findings()
    if not path.is_dir():
        data = check_file(path, findings)
        if data is None:
            return findings, ""
        about = f"task {data.task} of {data.meta['env']} ({data.meta['split']})"
        digest = data.meta["content_sha256"]
    else:
        dataset = check_folder(path, findings)
        if dataset is None:
            return findings, ""
        train, test = len(dataset.train_tasks), len(dataset.test_tasks)
        about = f"{dataset.env}, {len(dataset.tasks)} tasks ({train} train, {test} test)"
        digest = dataset.hash
    return findings, f"{path}: ok: {about}, {findings.counts()}, SHA-256 {digest[:16]}"


def _say(console: Console, text: str, style: str) -> None:
    console.print(text, style=style, markup=False, highlight=False)


def _check_all(paths: Sequence[Path], out: Console, err: Console) -> int:
    """Check every path and say what was found; returns the number of faults."""
    faults = 0
    for path in paths:
        findings, line = check(path)
        for sentence in findings.warnings:
            _say(err, f"warning: {sentence}", "yellow")
        for sentence in findings.faults:
            _say(err, sentence, "red")
        if findings.faults:
            _say(err, f"{path}: faults: {len(findings.faults)}, ok: {findings.tasks}", "red")
        else:
            _say(out, line, "green")
        faults += len(findings.faults)
    return faults


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        Exit code: 0 all is intact, 1 there are faults, 2 wrong usage, 130 interrupted.
    """
    config = tyro.cli(CheckConfig, prog="python -m datagen.check", args=arguments)
    out, err = Console(soft_wrap=True), Console(stderr=True, soft_wrap=True)
    wrong = [f"{path}: no such file or folder" for path in config.paths if not os.path.exists(path)]
    if wrong or not config.paths:
        for sentence in wrong or ["give at least one dataset's folder or task file"]:
            _say(err, f"{sentence}; see python -m datagen.check --help", "red")
        return 2
    try:
        return 1 if _check_all(config.paths, out, err) else 0
    except KeyboardInterrupt:
        _say(err, "interrupted: not everything was checked", "red")
        return 130


if __name__ == "__main__":
    sys.exit(main())
