"""Who may import whom. A file's folder is its layer, so a new file needs no line here.

Imports go down only, and nothing imports in a circle: no module, and no folder.
"""

import ast
import graphlib
import os
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from dora_systemd.cli.group import SECTIONS
from tests.unit.checkout import CHECKOUT, linked_package, module_paths, nodes_of

LAYERS = (
    {"words"},
    {"decisions"},
    {"trust"},
    {"adapters"},
    {"verbs", "runner", "link"},
    {"gateway"},
    {"cli"},
)
"""The folders in dora_systemd/, from the bottom up. Words are the files beside them. Two folders of
one layer do not import each other: verbs and runner meet in systemd."""

DEPTHS = {house: depth for depth, layer in enumerate(LAYERS) for house in layer}

ADAPTERS_MAY = {("adapters.dora", "adapters.host")}
"""An adapter imports no other one. But the dora command is a program, and a dataflow is a file."""

MAX_FILES = 20

PATHS = module_paths()

ONLY_IMPORTERS = {
    "click": {name for name in module_paths() if name.startswith("cli.")},
    "pydantic": {"decisions.settings.schema"},
    "pystemd": {"adapters.bus.library"},
    "systemd": {"adapters.journal.socket", "adapters.journal.reader", "adapters.host.notify"},
    "websockets": {"adapters.dora.websocket", "gateway.connection", "gateway.server"},
    "yaml": {"adapters.host.files", "adapters.host.yaml_edit", "adapters.host.yaml_loader"},
    "watchfiles": {"adapters.host.watch"},
}
"""Packages of others, and the modules of ours that may import them."""

LIBRARIES_OF_DECISIONS = {
    "decisions.settings.schema": {"pydantic"},
    "decisions.reload.watch_rules": {"pathspec"},
}
"""Words and decisions need nothing but the standard library, but for these."""

IMPURE = {
    *("asyncio", "glob", "io", "os", "random", "secrets", "select", "shutil", "socket"),
    *("subprocess", "tempfile", "threading"),
}
"""What no decision needs: input, output, chance."""

CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "sleep", "now", "utcnow", "today"}

NOT_IN_SHORT_LIVED_VERBS = {"tempfile", "pydantic", "websockets", "watchfiles", "asyncio"}

NOT_IN_RUNNERS = {
    *("click", "pathspec", "pydantic", "pystemd", "systemd", "watchfiles", "websockets", "yaml"),
    *("bz2", "email", "hashlib", "http", "lzma", "random", "shutil", "tempfile", "zipfile"),
}
"""What no runner loads to begin with. Each dataflow has a runner, and each of these is memory."""


def house_of(name: str) -> str:
    """The folder in dora_systemd/ that a module is in."""
    return name.partition(".")[0] if "." in name else "words"


def modules_of(*houses: str) -> list[str]:
    return sorted(name for name in PATHS if house_of(name) in houses)


def folder_of(name: str) -> str:
    return name.rpartition(".")[0] or name


@cache
def imports(name: str) -> tuple[set[str], set[str]]:
    """The modules of ours that a module imports anywhere in it, and the packages of others."""
    own, others = set(), set()
    for node in nodes_of(name):
        if isinstance(node, ast.ImportFrom):
            targets = {f"{node.module}.{alias.name}" for alias in node.names}
            targets = {one for one in targets if one.removeprefix("dora_systemd.") in PATHS}
            imported = targets or {node.module or ""}
        elif isinstance(node, ast.Import):
            imported = {alias.name for alias in node.names}
        else:
            continue
        own |= {one.removeprefix("dora_systemd.") for one in imported if "dora_systemd." in one}
        others |= {one.partition(".")[0] for one in imported if "dora_systemd" not in one}
    return own, others


def edges(*houses: str) -> Iterator[tuple[str, str]]:
    """The imports of modules of ours by those of these folders: who, and what."""
    for name in modules_of(*houses):
        yield from ((name, target) for target in sorted(imports(name)[0]))


def test_imports_go_down() -> None:
    upwards = {
        (name, target)
        for name, target in edges(*DEPTHS)
        if house_of(name) != house_of(target) and DEPTHS[house_of(name)] <= DEPTHS[house_of(target)]
    }
    assert not upwards, "a module imports one of its own layer or of a higher one"


def test_adapters_stand_alone() -> None:
    between = {
        (folder_of(name), folder_of(target))
        for name, target in edges("adapters")
        if house_of(target) == "adapters" and folder_of(target) != folder_of(name)
    }
    assert not between - ADAPTERS_MAY


def test_only_systemd_starts_runners_and_gateways() -> None:
    apart = {"runner", "gateway"}
    assert not {
        (name, target)
        for name, target in edges("gateway", "cli")
        if house_of(target) in apart - {house_of(name)}
    }


def test_no_module_imports_in_a_circle() -> None:
    graph = {name: imports(name)[0] & PATHS.keys() for name in PATHS}
    assert {*graphlib.TopologicalSorter(graph).static_order()} == PATHS.keys()


def test_no_folder_imports_in_a_circle() -> None:
    graph: dict[str, set[str]] = defaultdict(set)
    for name in PATHS:
        graph[folder_of(name)] |= {folder_of(target) for target in imports(name)[0]}
    for folder, targets in graph.items():
        targets.discard(folder)
    assert {*graphlib.TopologicalSorter(graph).static_order()} >= graph.keys()


def things_in(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name not in ("__init__.py", "__pycache__")]


def folders() -> list[Path]:
    """All folders of the package and of its unit tests; not those that Python has left behind."""
    tops = [CHECKOUT / "dora_systemd", CHECKOUT / "tests/unit"]
    found = [path for top in tops for path in (top, *top.rglob("*")) if path.is_dir()]
    return sorted(path for path in found if path.name != "__pycache__" and things_in(path))


def test_a_look_at_a_folder_is_enough() -> None:
    """Neither a heap of files nor a folder for a single thing."""
    held = {folder: things_in(folder) for folder in folders()}
    heaps = [one for one, things in held.items() if sum(map(Path.is_file, things)) > MAX_FILES]
    assert not heaps, f"more than {MAX_FILES} files: sort them into folders"
    lonely = [folder for folder, things in held.items() if len(things) < 2]
    assert not lonely, "it holds one thing: put that beside the folder"


def packages() -> list[Path]:
    top = CHECKOUT / "dora_systemd"
    return sorted(path.parent for path in top.rglob("*.py") if path.name == "__init__.py")


def test_every_folder_with_modules_is_installed() -> None:
    top = CHECKOUT / "dora_systemd"
    with_modules = {
        top / parent for path in top.rglob("*.py") for parent in path.relative_to(top).parents
    }
    assert with_modules == set(packages()), "a folder lacks __init__.py"
    names = {".".join(path.relative_to(CHECKOUT).parts) for path in packages()}
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    listed = set(project["tool"]["setuptools"]["packages"])
    listed -= {name for name in listed if name.startswith("dora_systemd.cli.")}
    elsewhere = set(project["tool"]["setuptools"]["package-dir"]) - {"dora_systemd"}
    assert names == listed - elsewhere, "correct the list of packages in pyproject.toml"


def test_every_section_of_verbs_is_installed() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    installed = set(project["tool"]["setuptools"]["packages"])
    assert {f"dora_systemd.cli.verbs.{one}" for one in SECTIONS} <= installed
    assert {path.name for path in (CHECKOUT / "cli/verbs").glob("[a-z]*")} == set(SECTIONS)


def test_packages_load_nothing() -> None:
    """Whoever imports a module from a package waits for its __init__.py, too."""
    bodies = {one: ast.parse((one / "__init__.py").read_text()).body for one in packages()[1:]}
    full = [
        package
        for package, body in bodies.items()
        if not all(isinstance(node, ast.Expr) for node in body)
    ]
    assert not full, "no more than a docstring"


def test_each_outside_thing_has_one_importer() -> None:
    foreign = {
        (name, one)
        for name in PATHS
        for one in imports(name)[1]
        if name not in ONLY_IMPORTERS.get(one, {name})
    }
    assert not foreign, "another module is the one that imports this package"


def test_words_and_decisions_need_python_only() -> None:
    names = modules_of("words", "decisions")
    found = {name: imports(name)[1] - sys.stdlib_module_names for name in names}
    assert {name: others for name, others in found.items() if others} == LIBRARIES_OF_DECISIONS


def test_decisions_are_pure() -> None:
    names = modules_of("decisions")
    used = {name: imports(name)[1] & IMPURE | clocks_of(name) for name in names}
    assert not {name: impure for name, impure in used.items() if impure}


def clocks_of(name: str) -> set[str]:
    """The clocks that a module reads."""
    return {
        node.attr
        for node in nodes_of(name)
        if isinstance(node, ast.Attribute)
        and node.attr in CLOCKS
        and isinstance(node.value, ast.Name)
        and node.value.id in ("time", "datetime", "date")
    }


def loaded_by(code: str, directory: Path) -> set[str]:
    """The names before the first dot of all modules that `code` loads."""
    environment = {**os.environ, "PYTHONPATH": str(linked_package(directory))}
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stderr
    return {module.partition(".")[0] for module in done.stdout.split()}


@pytest.mark.parametrize("verb", ["look.list", "run.stop", "look.logs", "look.why"])
def test_short_lived_verbs_load_little(verb: str, tmp_path: Path) -> None:
    loaded = loaded_by(f"import dora_systemd.cli.main, dora_systemd.cli.verbs.{verb}", tmp_path)
    assert not loaded & NOT_IN_SHORT_LIVED_VERBS


def test_runners_load_little(tmp_path: Path) -> None:
    code = (
        "import dora_systemd.runner.__main__ as main\nmain.leave_out_openssl()\n"
        "import dora_systemd.adapters.dora.check, dora_systemd.runner.main"
    )
    before = loaded_by("", tmp_path)  # what `site` loads, such as a finder of pip's
    assert not (loaded_by(code, tmp_path) - before) & NOT_IN_RUNNERS


def test_a_coordinator_waits_for_no_slow_module(tmp_path: Path) -> None:
    loaded = loaded_by("import dora_systemd.runner.__main__", tmp_path) - loaded_by("", tmp_path)
    assert not loaded & {"dataclasses", "inspect", "asyncio", "logging", "yaml"}


STARTS_PROGRAMS = {
    "trust.programs": "for others",
    "adapters.dora.engine": "dora's, in a cell",
    "adapters.journal.journalctl": "journalctl",
    "adapters.ssh": "ssh, as the caller",
    "link.talk": "ssh, as the caller of doractl start",
    "verbs.machines.member": "itself, as a smaller program",
    "adapters.host.guard": "itself, without another program",
    "verbs.node": "dora, as the caller",
    "verbs.inhibit": "what the caller has typed, as the caller",
    "cli.verbs.look.logs": "the caller's own pager",
    "adapters.runner_socket.relay": "itself, as the user of the dataflow",
    "trust.courier": "git, as the user of the nodes",
    "trust.terminals": "another user's program, on a terminal of its own",
}
"""The modules that start programs, and which."""

CALLS_OF_PROGRAMS = {"Popen", "check_call", "check_output", "execv", "execve", "execvp", "execvpe"}
CALLS_OF_PROGRAMS |= {"fork", "posix_spawn", "posix_spawnp", "system", "popen", "setuid", "setgid"}


def called(name: str) -> set[str]:
    """The names after a dot that a module uses."""
    return {
        node.func.attr
        for node in nodes_of(name)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }


def test_who_starts_programs() -> None:
    found = {name for name in PATHS if called(name) & CALLS_OF_PROGRAMS}
    assert found == STARTS_PROGRAMS.keys()


RUNS_DORA = {"run_dora", "dora_version", "load_dataflow", "prepare", "DoraCheck", "refusal_of_dora"}
ASKS_ROOTS_DORA = {"verbs.doctor", "verbs.version"}
"""They ask for a version only, of a dora that is root's when root asks."""


def test_dora_is_run_in_cells_only() -> None:
    used = {
        (name, alias.name)
        for name in modules_of("verbs", "gateway", "cli")
        for node in nodes_of(name)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name in RUNS_DORA
    }
    assert not used - {(name, "dora_version") for name in ASKS_ROOTS_DORA}
