"""Results of several seeds: mean, interval, inter-quartile mean."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctmrl.errors import UsageError
from ctmrl.settings import SETTINGS_FILE, with_later_settings

RESAMPLES = 10_000
APART = ("seed", "threads", "device")
"""Settings in which the runs of one mean may differ."""


@dataclass(frozen=True)
class Result:
    """One group of tasks of one method on one environment, over seeds.

    Attributes:
        env: environment.
        method: method.
        group: unseen, seen or fresh.
        seeds: the runs' seeds, sorted.
        returns: each seed's mean return.
        scores: each seed's normalised score, NaN where there is none.
        references: mean returns of the references on the same tasks.
        note: what a reader must know of the method, if anything.
    """

    env: str
    method: str
    group: str
    seeds: tuple[int, ...]
    returns: NDArray[np.float64]
    scores: NDArray[np.float64]
    references: dict[str, float]
    note: str = ""

    @property
    def title(self) -> str:
        """The method as a table names it."""
        return titled(self.method, self.note)


def titled(method: str, note: str) -> str:
    """A method's name with what a reader must know of it: `oracle_task (reference, ...)`."""
    return f"{method} ({note})" if note else method


def find_records(paths: list[Path]) -> list[dict[str, Any]]:
    """Read the evaluations of all runs in or below some folders, in the order of their paths.

    Raises:
        UsageError: there is none, or one cannot be read.
    """
    files = sorted({file for path in paths for file in path.glob("**/evaluation.json")})
    if not files:
        where = ", ".join(map(str, paths)) or "no folder"
        raise UsageError(
            f"no finished run in {where}: name folders that python -m ctmrl.train made"
        )
    records = []
    for file in files:
        try:
            record = json.loads(file.read_bytes())
            record["run"] = str(file.parent)
            _check(record)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(
                f"{file} is not an evaluation of a run ({error}): move it away"
            ) from None
        record["settings"] = _settings(file.parent)
        records.append(record)
    return records


def _settings(folder: Path) -> dict[str, Any]:
    """What a result depends on beside its seed, by name; empty where its folder does not have it.

    Raises:
        UsageError: it cannot be read.
    """
    names = (folder / name for name in ("config.json", SETTINGS_FILE))
    file = next((one for one in names if one.exists()), None)
    if file is None:
        return {}
    try:
        config = json.loads(file.read_bytes())
        settings = {"dataset": config["dataset"], **with_later_settings(config["settings"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{file} does not have a run's settings ({error}): move its folder away"
        ) from None
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= value if isinstance(value, dict) else {name: value}
    return {name: value for name, value in flat.items() if name not in APART}


def _check(record: dict[str, Any]) -> None:
    """Raise a KeyError, TypeError or ValueError unless it has all that `collate` uses."""
    int(record["seed"]), str(record["env"]), str(record["method"])
    for group in record["groups"].values():
        float(group["return"]), list(group["tasks"]), dict(group["references"])
        if group["score"] is not None:
            float(group["score"])


def collate(records: list[dict[str, Any]]) -> list[Result]:
    """Group records by environment, method and group of tasks.

    Raises:
        UsageError: two runs of one seed, of other settings, or scored on different tasks.
    """
    rows: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for record in records:
        for group in record["groups"]:
            rows.setdefault((record["env"], record["method"], group), []).append(record)
    results = []
    for (env, method, group), members in rows.items():
        members.sort(key=lambda record: int(record["seed"]))
        # All pairs: one whose settings are not known fits those beside it whatever they are.
        for one, other in combinations(members, 2):
            _check_fit(one, other, group)
        groups = [member["groups"][group] for member in members]
        results.append(
            Result(
                env,
                method,
                group,
                tuple(int(member["seed"]) for member in members),
                np.array([one["return"] for one in groups], dtype=np.float64),
                np.array([one["score"] for one in groups], dtype=np.float64),
                groups[0]["references"],
                members[0].get("note", ""),
            )
        )
    return results


def _check_fit(one: dict[str, Any], other: dict[str, Any], group: str) -> None:
    """Raise a UsageError unless two runs may stand in one mean."""
    both = f"{one['run']} and {other['run']}"
    if one["seed"] == other["seed"]:
        raise UsageError(
            f"{both} both have seed {one['seed']} of {one['method']} on {one['env']}: "
            "name the folders of one setting only"
        )
    for name in ("tasks", "params"):
        if one["groups"][group].get(name) != other["groups"][group].get(name):
            raise UsageError(f"{both} were scored on different {group} tasks: report them apart")
    ours, theirs = (run.get("settings", {}) | run.get("protocol", {}) for run in (one, other))
    for name in sorted(ours.keys() & theirs.keys()):
        if ours[name] != theirs[name]:
            raise UsageError(
                f"{both} differ in {name} ({ours[name]} and {theirs[name]}): report them apart"
            )


def interval(values: NDArray[np.float64], seed: int = 0) -> tuple[float, float]:
    """95% bootstrap interval of the mean over seeds (percentiles of resampled means)."""
    if len(values) < 2:
        return float("nan"), float("nan")
    from scipy.stats import bootstrap

    found = bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)


def interquartile_mean(values: NDArray[np.float64]) -> float:
    """Mean of the middle half of the values."""
    from scipy.stats import trim_mean

    return float(trim_mean(values, 0.25))


def to_csv(results: list[Result]) -> str:
    """One line a seed: environment, method, group, seed, return, score (empty: there is none)."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["env", "method", "group", "seed", "return", "score"])
    for result in results:
        for seed, value, score in zip(result.seeds, result.returns, result.scores, strict=True):
            row = [result.env, result.method, result.group, seed]
            writer.writerow([*row, f"{value:.4f}", "" if np.isnan(score) else f"{score:.2f}"])
    return buffer.getvalue()
