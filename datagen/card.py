"""The card of a dataset: the README.md in its folder, made from its index alone."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from datagen.budgets import other_options
from datagen.columns import COLUMNS
from datagen.groups import planned_groups, rows_text, trained_groups
from meta_envs import resolve, task_set
from meta_envs.registry import definition

CARD_FILE = "README.md"
"""Name of the card in the dataset's folder."""

_COLUMN_MEANS = {
    "observations": "observation before the action",
    "actions": "action of the behaviour policy, in [-1, 1]",
    "rewards": "reward of the step",
    "next_observations": "observation after the step, also at an episode's end",
    "terminals": "the environment ended the episode; never the time limit",
    "timeouts": "the time limit ended the episode",
    "episode": "number of the episode, from 0, without gaps",
    "checkpoint": "training steps of the policy that acted",
    "dense_rewards": "dense reward of the step, which the behaviour policy learned from",
}

_COLLECTION_SETTINGS = (
    "The behaviour policies are Stable-Baselines3's SAC. `datagen/budgets.py` says what each",
    "setting is; what is not listed has Stable-Baselines3's default.",
)
_FLEET_SETTINGS = (
    "The behaviour policies are Stable-Baselines3's SAC, those of a group of tasks trained side by",
    "side. `datagen/budgets.py` says what each setting is; what is not listed has",
    "Stable-Baselines3's default.",
)
_IMPORT_SETTINGS = (
    "What the import found. The seed of the collection is unknown, which -1 stands for; the",
    "versions are those of the import.",
)


def _settings_text(index: Mapping[str, Any]) -> tuple[str, ...]:
    if _is_legacy(index):
        return _IMPORT_SETTINGS
    return _FLEET_SETTINGS if "fleet" in index["config"] else _COLLECTION_SETTINGS


def remake_commands(index: Mapping[str, Any]) -> list[str]:
    """The commands that make a dataset again, byte for byte, without their `--out`.

    It is one, unless the groups of a fleet are not those of one command for all tasks, as where
    shards are missing or tasks were added later: then it is one for each group.

    Args:
        index: content of `dataset.json`.
    """
    words = ["python", "-m", "datagen.collect", "--env", index["env"], "--budget", index["budget"]]
    words += other_options(index["env"], index["budget"], index["config"])
    seed = ["--seed", str(index["seed"])]
    trained, tasks = trained_groups(index), [record["task"] for record in index["tasks"]]
    if trained != planned_groups(index):
        groups = dict.fromkeys(trained.values())
        return [shlex.join([*words, "--tasks", group, *seed]) for group in groups]
    if len(tasks) < len(task_set(index["env"])):
        words += ["--tasks", rows_text(tasks)]
    return [shlex.join([*words, *seed])]


def named_checkpoints(record: Mapping[str, Any]) -> dict[str, str]:
    """The first, the middle and the last checkpoint of a task's returns, by these words.

    The middle is left out where there are only two, and the first where there is only one.
    """
    marks = sorted(record["returns"]["behavior"], key=int)
    named = {"first": marks[0], "middle": marks[len(marks) // 2], "last": marks[-1]}
    if len(marks) < 3:
        del named["middle"]
    if len(marks) < 2:
        del named["first"]
    return named


def mean_returns(records: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Returns averaged over a group of tasks.

    Args:
        records: the tasks' records of an index, at least one.

    Returns:
        `random`, `expert`, `best` and `best deterministic` (of each task's best checkpoint),
        and `first`, `middle` and `last`, of those checkpoints as far as there are so many.
    """
    returns = [record["returns"] for record in records]
    found = {
        "random": [one["random"] for one in returns],
        **{
            name: [one["behavior"][mark] for one in returns]
            for name, mark in named_checkpoints(records[0]).items()
        },
        "best": [max(one["behavior"].values()) for one in returns],
        "best deterministic": [max(one["deterministic"].values()) for one in returns],
        "expert": [one["expert"] for one in returns],
    }
    return {name: float(sum(values) / len(values)) for name, values in found.items()}


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def _front_matter(index: Mapping[str, Any], rows: int) -> list[str]:
    lines = [
        "---",
        f"pretty_name: {index['env_id']} ({_pretty(index)})",
        # What somebody else collected is not ours to license.
        f"license: {'unknown' if _is_legacy(index) else 'mit'}",
        "task_categories:",
        "- reinforcement-learning",
        "tags:",
        *(f"- {tag}" for tag in ("offline-rl", "meta-rl", "gymnasium", index["env"])),
        "size_categories:",
        f"- {_size_category(rows)}",
        "configs:",
        f"- config_name: {index['env']}",
        "  data_files:",
    ]
    for split in ("train", "test"):
        files = [record["file"] for record in index["tasks"] if record["split"] == split]
        if files:
            lines += [f"  - split: {split}", "    path:", *(f"    - {file}" for file in files)]
    return [*lines, "---", ""]


def _pretty(index: Mapping[str, Any]) -> str:
    return "imported" if _is_legacy(index) else f"{index['budget']}, seed {index['seed']}"


def _size_category(rows: int) -> str:
    bounds = [(10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M")]
    bounds += [(10**7, "1M<n<10M"), (10**8, "10M<n<100M")]
    return next((name for bound, name in bounds if rows < bound), "100M<n<1B")


def _is_legacy(index: Mapping[str, Any]) -> bool:
    """Whether `datagen.exchange from-legacy` made the dataset."""
    return bool(index["config"].get("source") == "legacy")


def _about(index: Mapping[str, Any]) -> list[str]:
    env, records = index["env"], index["tasks"]
    row = resolve(env)
    names = ", ".join(f"`{name}`" for name in index["param_names"])
    return [
        f"# {index['env_id']}: offline meta-reinforcement-learning data",
        "",
        f"Transitions of `{index['env_id']}` on {len(records)} of its {len(task_set(env))} tasks. "
        f"What varies from task to task: {row.varies} (parameters {names}). "
        f"An episode has at most {row.horizon} steps.",
        "",
        *(_import_text(index) if _is_legacy(index) else _collection_text(index)),
        "Returns are undiscounted sums of `rewards`, means over tasks; the expert is "
        f"{_expert(index)}.",
        "",
    ]


def _expert(index: Mapping[str, Any]) -> str:
    if "oracle" in definition(index["env"]).controllers:
        return "the exact optimum"
    best = "the task's best deterministic checkpoint"
    if _is_legacy(index):
        return best
    marks = len(index["config"]["checkpoints"])
    return f"{best}, the best of {marks} that played one episode each, so it is optimistic"


def _collection_text(index: Mapping[str, Any]) -> list[str]:
    config, commands = index["config"], remake_commands(index)
    marks = config["checkpoints"]
    return [
        "On each task one soft actor-critic was trained from scratch. At each of "
        f"{len(marks)} checkpoints, after {marks[0]:,} to {marks[-1]:,} environment steps, its "
        f"stochastic policy played {config['episodes']} episodes. The data are a mixture of poor, "
        "middling and good behaviour.",
        "",
        f"Made again by {'these commands' if len(commands) > 1 else 'this command'}, byte for byte "
        "with the versions below on a like processor:",
        "",
        "```",
        *commands,
        "```",
        "",
    ]


def _import_text(index: Mapping[str, Any]) -> list[str]:
    config = index["config"]
    marks = config["checkpoints"]
    verified = (
        "Every step was computed anew from the task's parameters and agrees."
        if config["tasks_verified"]
        else "That its tasks are those of the environment here is taken on trust: they were "
        "matched by their numbers."
    )
    deterministic = (
        "Deterministic returns are those of its deterministic episodes."
        if config["deterministic_known"]
        else "It had no deterministic episodes; the deterministic returns repeat the stochastic "
        "ones."
    )
    return [
        "Imported by `python -m datagen.exchange from-legacy` from a folder of the field's older "
        f"format, with the episodes of {len(marks)} checkpoints after {marks[0]:,} to "
        f"{marks[-1]:,} training steps. {verified} {deterministic} Which learner, simulator, seed "
        "and versions made it is unknown, and so is why an episode ended: one shorter than the "
        "time limit ends in a terminal where tasks of this environment can end by themselves.",
        "",
    ]


def _returns_table(index: Mapping[str, Any]) -> list[str]:
    groups = {
        split: [record for record in index["tasks"] if record["split"] == split]
        for split in ("train", "test")
    }
    present = {split: records for split, records in groups.items() if records}
    rows = [
        [what, *(f"{sum(one[key] for one in records):,}" for records in present.values())]
        for what, key in (
            ("transitions", "transitions"),
            ("episodes", "episodes"),
            ("bytes", "bytes"),
        )
    ]
    rows.insert(0, ["tasks", *(str(len(records)) for records in present.values())])
    means = {split: mean_returns(records) for split, records in present.items()}
    marks = named_checkpoints(index["tasks"][0])
    titles = {
        "random": "random policy",
        **{name: f"{name} checkpoint, {int(mark):,} steps" for name, mark in marks.items()},
        "best": "best checkpoint of each task",
        "best deterministic": "best checkpoint of each task, deterministic",
        "expert": "expert",
    }
    rows += [
        [f"return: {title}", *(f"{means[split][name]:.2f}" for split in present)]
        for name, title in titles.items()
    ]
    head = ["", *(f"{split} tasks" for split in present)]
    return ["## Sizes and returns", "", *_table(head, rows), ""]


def _columns_table(index: Mapping[str, Any]) -> list[str]:
    env = definition(index["env"])
    widths = {
        "observations": env.observation_space.shape[0],
        "next_observations": env.observation_space.shape[0],
        "actions": env.action_space.shape[0],
    }
    rows = [
        [
            f"`{name}`",
            dtype.name,
            f"N x {widths[name]}" if name in widths else "N",
            _COLUMN_MEANS[name],
        ]
        for name, dtype in COLUMNS.items()
        if env.sparse or name != "dense_rewards"
    ]
    return [
        "## Columns",
        "",
        "One HDF5 file a task, `task_003.h5` for task 3. All columns of a file have the same",
        "length N; its attribute `meta` is a JSON text with everything else. `dataset.json` lists",
        "the files with their SHA-256, the tasks' parameters and the returns of every checkpoint.",
        "",
        *_table(["column", "type", "shape", "meaning"], rows),
        "",
        "```python",
        "from datagen.dataset import open_dataset",
        "",
        'dataset = open_dataset("path/to/this/folder")',
        "data = dataset.read(int(dataset.train_tasks[0]))",
        'print(data.observations.shape, data.meta["params"])',
        "```",
        "",
    ]


def _settings_tables(index: Mapping[str, Any]) -> list[str]:
    config = dict(index["config"])
    learner = config.pop("sac", {})
    settings = [*sorted({**config, "seed": index["seed"]}.items()), *sorted(learner.items())]
    shown = [[f"`{key}`", _setting(value)] for key, value in settings]
    versions = [[name, version] for name, version in sorted(index["versions"].items())]
    return [
        "## Settings",
        "",
        *_settings_text(index),
        "",
        *_table(["setting", "value"], shown),
        "",
        "## Versions",
        "",
        *_table(["package", "version"], versions),
        "",
        f"SHA-256 of the task set: `{index['task_hash']}`",
    ]


def _setting(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, Mapping):
        # In an order of its own: an index that was read has another than one that was just made.
        return ", ".join(f"{key} {_setting(part)}" for key, part in sorted(value.items()))
    plain = isinstance(value, bool) or not isinstance(value, int)
    return str(value) if plain else f"{value:,}"


def card(index: Mapping[str, Any]) -> str:
    """The card's text, Markdown with Hugging Face's front matter; the same index, the same text.

    Args:
        index: content of `dataset.json`; `sha256` is not needed.
    """
    total = sum(record["transitions"] for record in index["tasks"])
    lines = [
        *_front_matter(index, total),
        *_about(index),
        *_returns_table(index),
        *_columns_table(index),
        *_settings_tables(index),
    ]
    return "\n".join(lines) + "\n"
