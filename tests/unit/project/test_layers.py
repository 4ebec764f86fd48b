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
from functools import cache
from pathlib import Path

import pytest

from dora_systemd.cli.group import SECTIONS
from tests.unit.checkout import CHECKOUT, linked_package, module_paths

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
    "yaml": {"adapters.host.files", "adapters.host.yaml_loader"},
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
    for node in ast.walk(ast.parse(PATHS[name].read_text())):
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


@pytest.mark.parametrize("name", sorted(PATHS))
def test_imports_go_down(name: str) -> None:
    own, depth = house_of(name), DEPTHS[house_of(name)]
    houses = {target: house_of(target) for target in imports(name)[0]}
    wrong = [target for target, house in houses.items() if house != own and DEPTHS[house] >= depth]
    assert not wrong, f"{name} must not import {', '.join(sorted(wrong))}"


@pytest.mark.parametrize("name", modules_of("adapters"))
def test_adapters_stand_alone(name: str) -> None:
    edges = {
        (folder_of(name), folder_of(target))
        for target in imports(name)[0]
        if house_of(target) == "adapters" and folder_of(target) != folder_of(name)
    }
    assert not edges - ADAPTERS_MAY


@pytest.mark.parametrize("name", modules_of("gateway", "cli"))
def test_only_systemd_starts_runners_and_gateways(name: str) -> None:
    apart = {"runner", "gateway"} - {house_of(name)}
    assert not apart & {house_of(target) for target in imports(name)[0]}


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


@pytest.mark.parametrize("folder", folders(), ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_a_look_at_a_folder_is_enough(folder: Path) -> None:
    """Neither a heap of files nor a folder for a single thing."""
    things = things_in(folder)
    files = [path for path in things if path.is_file()]
    assert len(files) <= MAX_FILES, f"{len(files)} files in {folder}: sort them into folders"
    assert len(things) > 1, f"{folder} holds one thing: put it beside the folder"


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


@pytest.mark.parametrize("package", packages()[1:], ids=lambda path: path.name)
def test_packages_load_nothing(package: Path) -> None:
    """Whoever imports a module from a package waits for its __init__.py, too."""
    body = ast.parse((package / "__init__.py").read_text()).body
    assert all(isinstance(node, ast.Expr) for node in body), "no more than a docstring"


@pytest.mark.parametrize("name", sorted(PATHS))
def test_each_outside_thing_has_one_importer(name: str) -> None:
    foreign = {one for one in imports(name)[1] if name not in ONLY_IMPORTERS.get(one, {name})}
    assert not foreign, f"{name} must not import {', '.join(sorted(foreign))}"


@pytest.mark.parametrize("name", sorted({*modules_of("words"), *modules_of("decisions")}))
def test_words_and_decisions_need_python_only(name: str) -> None:
    others = imports(name)[1] - sys.stdlib_module_names
    assert others == LIBRARIES_OF_DECISIONS.get(name, set())


@pytest.mark.parametrize("name", modules_of("decisions"))
def test_decisions_are_pure(name: str) -> None:
    tree = ast.parse(PATHS[name].read_text())
    impure = imports(name)[1] & IMPURE
    clocks = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and node.attr in CLOCKS
        and isinstance(node.value, ast.Name)
        and node.value.id in ("time", "datetime", "date")
    }
    assert not impure | clocks, f"{name} uses {', '.join(sorted(impure | clocks))}"


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
    tree = ast.parse(module_paths()[name].read_text())
    return {
        node.func.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }


def test_who_starts_programs() -> None:
    found = {name for name in module_paths() if called(name) & CALLS_OF_PROGRAMS}
    assert found == STARTS_PROGRAMS.keys()


RUNS_DORA = {"run_dora", "dora_version", "load_dataflow", "prepare", "DoraCheck", "refusal_of_dora"}
ASKS_ROOTS_DORA = {"verbs.doctor", "verbs.version"}
"""They ask for a version only, of a dora that is root's when root asks."""


@pytest.mark.parametrize("name", modules_of("verbs", "gateway", "cli"))
def test_dora_is_run_in_cells_only(name: str) -> None:
    tree = ast.parse(PATHS[name].read_text())
    imported = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    allowed = {"dora_version"} if name in ASKS_ROOTS_DORA else set()
    assert not (imported & RUNS_DORA) - allowed
