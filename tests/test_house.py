"""The rules of the house, read from the source: who imports whom, sizes, tests, words.

A rule is a function from a folder to a list of sentences, one for each breach; every rule is also
run on a small tree that breaks it, so that it is known to be able to fail.
"""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("meta_envs", "datagen", "ctmrl")
MAX_LINES = 400

COMMAND_LINE = {"tyro", "rich"}
MAY_IMPORT: dict[str, set[str]] = {
    "meta_envs": {"meta_envs", "gymnasium", "mujoco", "numpy", "PIL"},
    "meta_envs.__main__": {"meta_envs", *COMMAND_LINE},
    "meta_envs.commands": {"meta_envs", "numpy", "PIL", *COMMAND_LINE},
    "datagen": {
        "datagen", "meta_envs", "gymnasium", "h5py", "matplotlib", "minari", "numpy", "PIL", "ray",
        "safetensors", "stable_baselines3", "torch", *COMMAND_LINE,
    },
    "ctmrl": {
        "ctmrl", "datagen.accelerator", "datagen.dataset", "meta_envs", "matplotlib", "numpy",
        "PIL", "safetensors", "scipy", "sklearn", "tensorboard", "threadpoolctl", "torch",
        "trackio", "wandb", *COMMAND_LINE,
    },
}  # fmt: skip
"""What a module may import beside the standard library; its longest matching prefix counts."""
DATASET_MAY_IMPORT = {"numpy", "h5py", "meta_envs"}
"""What `datagen.dataset` may import, itself or through other modules of datagen."""
PICKLERS = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
WITHOUT_A_TEST: dict[str, str] = {}
"""Modules that need no test file of their name: module -> reason."""
FOREIGN_PATHS = ("/wo" + "rk/", "/tmp/bash" + "_jobs")


@dataclass(frozen=True)
class Import:
    """One import statement's target: `module` imports `target` at a line of its file."""

    module: str
    target: str
    line: int
    only_typing: bool


def modules(root: Path, packages: tuple[str, ...] = PACKAGES) -> dict[str, Path]:
    """Every module of the packages by its dotted name; a package's is that of its __init__."""
    found = {}
    for package in packages:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def _guarded(node: ast.AST) -> set[ast.AST]:
    """All nodes that stand below `if TYPE_CHECKING:`."""
    guards = (
        one
        for one in ast.walk(node)
        if isinstance(one, ast.If) and ast.unparse(one.test).endswith("TYPE_CHECKING")
    )
    return {below for guard in guards for part in guard.body for below in ast.walk(part)}


def imports(root: Path) -> Iterator[Import]:
    """Every import of the packages, also inside functions; the target is a module of ours in full.

    `from a import b` is an import of a.b where that is a module, and of a otherwise.
    """
    known = modules(root)
    for module, path in known.items():
        tree = ast.parse(path.read_text())
        guarded = _guarded(tree)
        parent = module if path.name == "__init__.py" else module.rpartition(".")[0]
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    above = parent.split(".")[: len(parent.split(".")) - node.level + 1]
                    base = ".".join([*above, base] if base else above)
                full = [f"{base}.{alias.name}" for alias in node.names]
                targets = [name if name in known else base for name in full]
            else:
                continue
            for target in targets:
                yield Import(module, target, node.lineno, node in guarded)


def _within(target: str, allowed: set[str]) -> bool:
    parts = target.split(".")
    return any(".".join(parts[: end + 1]) in allowed for end in range(len(parts)))


def _foreign(target: str) -> bool:
    return target.partition(".")[0] not in sys.stdlib_module_names


def layering(root: Path) -> list[str]:
    """Imports that the table above does not allow, also those only type checkers see."""
    breaches = []
    for one in imports(root):
        prefixes = [name for name in MAY_IMPORT if f"{one.module}.".startswith(f"{name}.")]
        allowed = MAY_IMPORT[max(prefixes, key=len)]
        if _foreign(one.target) and not _within(one.target, allowed):
            breaches.append(f"{one.module}:{one.line} may not import {one.target}")
    return breaches


def light_dataset(root: Path) -> list[str]:
    """Imports that reading a dataset must not need, in all modules that `datagen.dataset` uses."""
    every = list(imports(root))
    reached, todo = set(), ["datagen.dataset"]
    while todo:
        module = todo.pop()
        reached.add(module)
        own = {one.target for one in every if one.module == module and not one.only_typing}
        todo += [target for target in own - reached if _within(target, {"datagen"})]
    allowed = {*DATASET_MAY_IMPORT, "datagen"}
    return [
        f"{one.module}:{one.line} is needed by datagen.dataset and may not import {one.target}"
        for one in every
        if one.module in reached and _foreign(one.target) and not _within(one.target, allowed)
    ]


def cycles(root: Path) -> list[str]:
    """Modules that import each other in a circle, at import time or later inside a function."""
    edges: dict[str, set[str]] = {module: set() for module in modules(root)}
    for one in imports(root):
        if one.target in edges and not one.only_typing:
            edges[one.module].add(one.target)
    # What is left after taking away, again and again, all that imports nothing left is circular.
    while leaves := {module for module, targets in edges.items() if not targets & edges.keys()}:
        edges = {module: targets for module, targets in edges.items() if module not in leaves}
    return [
        f"{module} is in, or leads to, an import cycle: it imports {', '.join(sorted(circular))}"
        for module, targets in edges.items()
        if (circular := targets & edges.keys())
    ]


def lengths(root: Path) -> list[str]:
    """Files of more than 400 lines, tests and benchmarks among them."""
    paths = modules(root, (*PACKAGES, "tests", "benchmarks")).values()
    counts = {path: len(path.read_text().splitlines()) for path in paths}
    return [
        f"{path.relative_to(root)} has {n} lines" for path, n in counts.items() if n > MAX_LINES
    ]


def pickles(root: Path) -> list[str]:
    """Imports of modules that can run code when they read a file."""
    return [
        f"{one.module}:{one.line} imports {one.target}"
        for one in imports(root)
        if one.target.partition(".")[0] in PICKLERS
    ]


def _does_something(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether a function is more than a docstring, as abstract ones are not."""
    passive = (ast.Pass, ast.Raise)
    return not all(
        isinstance(one, passive)
        or (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))
        for one in function.body
    )


def has_code(source: str) -> bool:
    """Whether a module does anything: functions with a body, or statements that are run."""
    tree = ast.parse(source)
    running = (ast.For, ast.While, ast.With, ast.Try)
    return any(isinstance(node, running) for node in tree.body) or any(
        isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _does_something(node)
        for node in ast.walk(tree)
    )


def missing_tests(root: Path, exempt: Mapping[str, str] = WITHOUT_A_TEST) -> list[str]:
    """Modules with code but without tests/<package>/test_<module>.py, and idle exemptions."""
    breaches = []
    for module, path in modules(root).items():
        stem = "main" if path.stem in ("__init__", "__main__") else path.stem
        test = root / "tests" / path.relative_to(root).parent / f"test_{stem}.py"
        needed = has_code(path.read_text()) and not test.exists()
        if needed and module not in exempt:
            breaches.append(f"{module} has no test file {test.relative_to(root)}")
        if not needed and module in exempt:
            breaches.append(f"{module} needs no exemption")
    return breaches + [f"{module} is exempt but absent" for module in exempt.keys() - modules(root)]


def foreign_paths(root: Path) -> list[str]:
    """Text files under version control, or about to be, that name a path of somebody's machine."""
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listing, cwd=root, capture_output=True, check=True).stdout.split(b"\0")
    paths = [root / name.decode() for name in names if name and (root / name.decode()).is_file()]
    return [
        f"{path.relative_to(root)} names {foreign}"
        for path in paths
        for foreign in FOREIGN_PATHS
        if b"\0" not in (content := path.read_bytes()) and foreign.encode() in content
    ]


Rule = Callable[[Path], list[str]]
RULES: list[Rule] = [layering, light_dataset, cycles, lengths, pickles, missing_tests]


@pytest.mark.parametrize("rule", RULES)
def test_the_house_keeps(rule: Rule) -> None:
    assert rule(ROOT) == []


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="only a checkout has tracked files")
def test_no_file_names_a_path_of_somebodys_machine() -> None:
    assert foreign_paths(ROOT) == []


def build(root: Path, **files: str) -> Path:
    """A tree of three packages with these files; in a key, `__` stands for a folder's slash."""
    for package in PACKAGES:
        (root / package).mkdir()
        (root / package / "__init__.py").write_text('"""Docstring."""\n')
    for name, source in files.items():
        path = root / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    return root


LATE = "def f():\n    import {}\n"
TYPED = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import {}\n"


@pytest.mark.parametrize(
    ("rule", "files", "breach"),
    [
        (layering, {"meta_envs__a": "import torch"}, "meta_envs.a:1 may not import torch"),
        (layering, {"meta_envs__a": "import datagen"}, "meta_envs.a:1 may not import datagen"),
        (
            layering,
            {"meta_envs__a": "import rich.table"},
            "meta_envs.a:1 may not import rich.table",
        ),
        (layering, {"meta_envs__a": LATE.format("h5py")}, "meta_envs.a:2 may not import h5py"),
        (layering, {"meta_envs__a": TYPED.format("h5py")}, "meta_envs.a:3 may not import h5py"),
        (layering, {"datagen__a": "from ctmrl import x"}, "datagen.a:1 may not import ctmrl"),
        (
            layering,
            {"ctmrl__a": "from datagen import rollout", "datagen__rollout": ""},
            "ctmrl.a:1 may not import datagen.rollout",
        ),
        (
            layering,
            {"ctmrl__b__a": "import stable_baselines3.sac"},
            "ctmrl.b.a:1 may not import stable_baselines3.sac",
        ),
        (
            light_dataset,
            {"datagen__dataset": "from . import a", "datagen__a": LATE.format("torch")},
            "datagen.a:2 is needed by datagen.dataset and may not import torch",
        ),
        (
            cycles,
            {"ctmrl__a": "from ctmrl.b import x", "ctmrl__b": "def f():\n    from . import a"},
            "ctmrl.a is in, or leads to, an import cycle: it imports ctmrl.b",
        ),
        (lengths, {"tests__test_a": "a = 1\n" * 401}, "tests/test_a.py has 401 lines"),
        (pickles, {"ctmrl__a": "import os, pickle"}, "ctmrl.a:1 imports pickle"),
        (
            missing_tests,
            {"ctmrl__b__a": "def f():\n    return 1"},
            "ctmrl.b.a has no test file tests/ctmrl/b/test_a.py",
        ),
    ],
)
def test_a_rule_sees_what_breaks_it(
    rule: Rule, files: dict[str, str], breach: str, tmp_path: Path
) -> None:
    found = rule(build(tmp_path, **files))
    assert found[:1] == [breach]


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_is_content_with_what_it_allows(rule: Rule, tmp_path: Path) -> None:
    root = build(
        tmp_path,
        meta_envs__a="import os\nimport numpy.typing\n" + TYPED.format("meta_envs.b"),
        meta_envs__b="import meta_envs.a",
        datagen__dataset="import h5py\nfrom datagen.columns import x\nfrom meta_envs import a",
        datagen__columns="def f():\n    return 1",
        datagen__collect=LATE.format("stable_baselines3") + "import tyro, datagen.dataset",
        tests__datagen__test_columns="a = 1\n" * 400,
        tests__datagen__test_collect="",
        ctmrl__a="import torch.nn\nfrom datagen.dataset import x\nclass A:\n    size: int = 1",
        ctmrl__c="from datagen.accelerator import x",
        datagen__accelerator="import torch",
        ctmrl__b="class B:\n    def f(self):\n        'Docstring.'\n        raise KeyError",
    )
    assert rule(root) == []


def test_an_exemption_must_be_needed(tmp_path: Path) -> None:
    root = build(tmp_path, ctmrl__a="def f():\n    return 1", ctmrl__b="x = 1")
    assert missing_tests(root, {"ctmrl.a": "reason"}) == []
    found = missing_tests(root, dict.fromkeys(("ctmrl.a", "ctmrl.b", "ctmrl.c"), "reason"))
    assert found == ["ctmrl.b needs no exemption", "ctmrl.c is exempt but absent"]


def test_a_path_of_somebodys_machine_is_seen(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    (tmp_path / ".gitignore").write_text("ignored.txt\n")
    for name in ("page.md", "ignored.txt"):
        (tmp_path / name).write_text(f"see {FOREIGN_PATHS[0]}main")
    (tmp_path / "picture.png").write_bytes(b"\0" + FOREIGN_PATHS[0].encode())
    assert foreign_paths(tmp_path) == [f"page.md names {FOREIGN_PATHS[0]}"]


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("meta_envs", {"torch", "mujoco", "matplotlib", "PIL", "h5py", "stable_baselines3"}),
        ("datagen.dataset", {"torch", "stable_baselines3", "mujoco", "matplotlib"}),
    ],
)
def test_an_import_stays_light(module: str, heavy: set[str]) -> None:
    code = f"import sys, {module}; print(*({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
