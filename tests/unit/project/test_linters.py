"""The tree is clean: ruff, mypy, short modules, short functions, documented interfaces."""

import ast
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.checkout import CHECKOUT, linked_package, module_paths, nodes_of, tree_of

MAX_LINES = 400
MEDIAN_LINES = 6
MOST_LINES = 50
"""Of a function, with its docstring: that of a verb is its --help."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def run(command: list[str], directory: Path, environment: dict[str, str]) -> None:
    """Run a linter; its output is the whole of the failure."""
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=directory,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        pytest.fail(f"{' '.join(command)}\n{done.stdout}{done.stderr}", pytrace=False)


def cache_directory(config: pytest.Config, name: str) -> Path:
    """A directory that stays from run to run: linters are slow without their caches."""
    # The attribute is missing with `-p no:cacheprovider`.
    cache = getattr(config, "cache", None)
    return cache.mkdir(name) if cache else CHECKOUT / ".pytest_cache" / name


def test_ruff(pytestconfig: pytest.Config) -> None:
    cache = str(cache_directory(pytestconfig, "ruff"))
    run(["ruff", "check", "--output-format=concise", "."], CHECKOUT, {"RUFF_CACHE_DIR": cache})


def test_mypy(pytestconfig: pytest.Config) -> None:
    place = linked_package(cache_directory(pytestconfig, "package"))
    cache = str(cache_directory(pytestconfig, "mypy"))
    config = f"--config-file={CHECKOUT / 'pyproject.toml'}"
    # The lab's modules have other names: the builder's test below reads them.
    folders = {path.parent.name for path in CHECKOUT.glob("tests/*/__init__.py")} - {"lab"}
    tests = (f"tests/{name}" for name in sorted(folders))
    run(["mypy", config, "dora_systemd", "benchmarks", *tests], place, {"MYPY_CACHE_DIR": cache})


def test_mypy_of_the_builder(pytestconfig: pytest.Config, tmp_path: Path) -> None:
    for name, target in (("builder", "packaging/builder"), ("lab", "tests/lab")):
        (tmp_path / name).symlink_to(CHECKOUT / target)
    cache = str(cache_directory(pytestconfig, "mypy-builder"))
    config = f"--config-file={CHECKOUT / 'pyproject.toml'}"
    run(["mypy", config, "builder"], tmp_path, {"MYPY_CACHE_DIR": cache})


def test_modules_are_short() -> None:
    counts = {name: len(path.read_text().splitlines()) for name, path in module_paths().items()}
    long = {name: count for name, count in counts.items() if count >= MAX_LINES}
    assert not long, "split it"


def functions() -> Iterator[tuple[str, Function]]:
    for name in module_paths():
        for node in nodes_of(name):
            if isinstance(node, Function):
                yield f"{name}.{node.name}", node


def test_functions_are_short() -> None:
    lengths = {
        name: (function.end_lineno or 0) - function.lineno + 1 for name, function in functions()
    }
    long = {name: count for name, count in lengths.items() if count > MOST_LINES}
    assert not long, "split it"
    assert statistics.median(lengths.values()) <= MEDIAN_LINES


def test_modules_are_documented() -> None:
    """Modules, and what of them other modules may use."""
    assert not [name for name in module_paths() if not ast.get_docstring(tree_of(name))]
    bare = [
        f"{name}.{node.name}"
        for name in module_paths()
        for node in tree_of(name).body
        if isinstance(node, Function | ast.ClassDef)
        if not node.name.startswith("_") and not ast.get_docstring(node)
    ]
    assert not bare, "no docstring"


def test_no_drawers_for_everything() -> None:
    stems = {name.rpartition(".")[2] for name in module_paths()}
    assert not stems & {"util", "utils", "helper", "helpers", "misc", "common"}
