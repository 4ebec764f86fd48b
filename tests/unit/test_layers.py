"""The table of layers: who may import whom. Every module is in it; a new file is one line.

Imports go down only. The groups of a layer do not import each other, but for the words and the
decisions, which are one group each. Nothing imports in a circle.
"""

import ast
import graphlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.unit.checkout import linked_package, module_paths

WORDS = {
    "words": [
        "errors",
        "values",
        "names",
        "scope",
        "cellpaths",
        "gatewayplace",
    ],
}
DECISIONS = {
    "decisions": [
        "backlog",
        "buildsession",
        "busprotocol",
        "cellstate",
        "causes",
        "cellview",
        "compat",
        "coordinator",
        "credentials",
        "dataflow",
        "dataflownodes",
        "diagnosis",
        "doraenv",
        "doraerrors",
        "environment",
        "events",
        "findings",
        "gatewayaccess",
        "gatewayport",
        "gatewayrequest",
        "gatewaycontrolanswers",
        "gatewaycontrolframes",
        "gatewaycontrolmatch",
        "hotreload",
        "jsonvalues",
        "launch",
        "lifecycle",
        "lifefailures",
        "lifehandlers",
        "lifeevents",
        "lifestory",
        "limitchecks",
        "limits",
        "limitsettings",
        "logfields",
        "logquery",
        "livemessages",
        "linelimiter",
        "lograte",
        "lograteplan",
        "logs",
        "logterminal",
        "metrics",
        "nodetable",
        "oom",
        "options",
        "postmortem",
        "postmortemtext",
        "pressure",
        "properties",
        "propertykinds",
        "propertylists",
        "propertynumbers",
        "propertyset",
        "propertystructs",
        "propertytable",
        "protocol",
        "pythonimports",
        "refusal",
        "reload",
        "reloadplan",
        "reloadsettings",
        "reloadsteps",
        "restartplan",
        "restarts",
        "restartsettings",
        "sandbox",
        "sandboxsettings",
        "sandboxsigns",
        "settingkinds",
        "settings",
        "settingschange",
        "settingschema",
        "settingtable",
        "setupfiles",
        "snapshot",
        "status",
        "statuswords",
        "stopbudget",
        "suggestions",
        "terminaltext",
        "toptable",
        "unitfile",
        "unitplaces",
        "unitsyntax",
        "usage",
        "verdict",
        "wiring",
        "watchrules",
    ],
}
TRUST = {
    "trust": [
        "trust.cells",
        "trust.paths",
        "trust.programs",
        "trust.sight",
        "trust.sockets",
        "trust.terminals",
        "sockettable",
    ],
}
"""The one door to what others own; the adapters go through it, too."""
ADAPTERS = {
    "bus": ["bus", "busconnection", "buserrors", "buslibrary", "buswire"],
    "cgroup": ["cgroup", "cgroupmemory", "cgroupstrain"],
    "control": ["control", "websocket"],
    "engine": ["engine"],
    "fdstore": ["fdstore"],
    "files": ["files", "unitfiles", "yamlloader"],
    "journal": ["journal", "journalnote"],
    "journalread": ["journalread"],
    "jsonl": ["jsonl"],
    "loopback": ["loopback"],
    "machine": ["machine"],
    "notify": ["notify"],
    "pipes": ["pipes", "pipesource", "heldlines", "logqueue"],
    "process": ["process"],
    "proctable": ["proctable"],
    "runnersocket": ["runnersocket", "runnerlistener", "relay", "splice"],
    "watch": ["watch"],
}
SHARED = {
    "preparation": ["doracheck", "preparation"],
}
"""What both use cases do with several adapters."""
USE_CASES = {
    "manager": [
        "manageraccount",
        "managerask",
        "managerbudget",
        "managercells",
        "managercheck",
        "managerclaim",
        "managercredentials",
        "managerdestroy",
        "managerdoctor",
        "managerenable",
        "managerenabled",
        "managerended",
        "managerenv",
        "managerexport",
        "managergateway",
        "managerlaunch",
        "managerlimits",
        "managerlinger",
        "managerlogins",
        "managerfollow",
        "managerlist",
        "managerlook",
        "managerlogs",
        "managernode",
        "managernodes",
        "managerplan",
        "managerreason",
        "managerreload",
        "managerreset",
        "managerrun",
        "managersandbox",
        "managerset",
        "managersettings",
        "managerslice",
        "managersetup",
        "managershow",
        "managersnapshot",
        "managerstart",
        "managerstop",
        "managertop",
        "managerunit",
        "managerup",
        "managerversion",
        "managerwhy",
        "managerwatch",
        "managerwords",
    ],
    "runner": [
        "runner",
        "runnerapply",
        "runnerbegin",
        "runnercheck",
        "runnerclock",
        "runnerfailure",
        "runnerpause",
        "runnercell",
        "runnerask",
        "runnerdialogue",
        "runnerengine",
        "runnerhold",
        "runnerloss",
        "runnernodes",
        "runnerpost",
        "runnerpump",
        "runnerreload",
        "runnerrooms",
        "runnerresources",
        "runnersettings",
        "runnersources",
        "runnerswap",
    ],
}
GATEWAY = {
    "gateway": [
        "gateway",
        "gatewayact",
        "gatewayfollow",
        "gatewaylive",
        "gatewaymetrics",
        "gatewaypage",
        "gatewaycontrol",
        "gatewaycontrolcell",
        "gatewaycontrollogs",
        "gatewaycontrolstart",
        "gatewaycontrolstate",
        "gatewaycontrolstop",
        "gatewaycontroltalk",
        "gatewayroutes",
        "gatewayserver",
    ],
}
"""It does for others what the manager does for doractl, and so stands above it. The runner is none
of its business: they meet in systemd."""
CLI = {"cli": sorted(name for name in module_paths() if name.startswith("cli."))}

LAYERS = [WORDS, DECISIONS, TRUST, ADAPTERS, SHARED, USE_CASES, GATEWAY, CLI]

PLACES = {
    module: (depth, group)
    for depth, layer in enumerate(LAYERS)
    for group, modules in layer.items()
    for module in modules
}

ONLY_IMPORTERS = {
    "click": {name for name in module_paths() if name.startswith("cli.")},
    "pydantic": {"settingschema"},
    "pystemd": {"buslibrary"},
    "systemd": {"journal", "journalread", "notify"},
    "websockets": {"control", "websocket", "gatewayserver"},
    "yaml": {"files", "yamlloader"},
    "watchfiles": {"watch"},
}
"""Packages of others, and the modules of ours that may import them."""

IMPURE = {
    *("asyncio", "glob", "io", "os", "random", "secrets", "select", "shutil", "socket"),
    *("subprocess", "tempfile", "threading"),
}
"""What no decision needs: input, output, chance."""

CLOCKS = {"time", "time_ns", "monotonic", "monotonic_ns", "sleep", "now", "utcnow", "today"}

NOT_IN_SHORT_LIVED_VERBS = {"tempfile", "pydantic", "websockets", "watchfiles", "asyncio"}


def imports(name: str) -> tuple[set[str], set[str]]:
    """The modules of ours that a module imports anywhere in it, and the packages of others."""
    own, others = set(), set()
    for node in ast.walk(ast.parse(module_paths()[name].read_text())):
        if isinstance(node, ast.ImportFrom):
            targets = {f"{node.module}.{alias.name}" for alias in node.names}
            targets = {one for one in targets if one.removeprefix("dora_systemd.") in PLACES}
            imported = targets or {node.module or ""}
        elif isinstance(node, ast.Import):
            imported = {alias.name for alias in node.names}
        else:
            continue
        own |= {one.removeprefix("dora_systemd.") for one in imported if "dora_systemd." in one}
        others |= {one.partition(".")[0] for one in imported if "dora_systemd" not in one}
    return own, others


def test_every_module_is_in_the_table() -> None:
    missing = module_paths().keys() - PLACES.keys()
    gone = PLACES.keys() - module_paths().keys()
    assert not missing, f"add to the table of layers: {sorted(missing)}"
    assert not gone, f"take out of the table of layers: {sorted(gone)}"


@pytest.mark.parametrize("name", sorted(module_paths().keys() & PLACES.keys()))
def test_imports_go_down(name: str) -> None:
    depth, group = PLACES[name]
    wrong = [
        target
        for target in imports(name)[0]
        if target in PLACES
        and (
            PLACES[target][0] > depth or (PLACES[target][0] == depth and PLACES[target][1] != group)
        )
    ]
    assert not wrong, f"{name} of {group} must not import {', '.join(sorted(wrong))}"


@pytest.mark.parametrize("name", [*GATEWAY["gateway"], *CLI["cli"]])
def test_only_systemd_starts_runners_and_gateways(name: str) -> None:
    apart = {*USE_CASES["runner"], *(GATEWAY["gateway"] if name in CLI["cli"] else ())}
    assert not imports(name)[0] & apart


def test_nothing_imports_in_a_circle() -> None:
    graph = {name: imports(name)[0] & PLACES.keys() for name in PLACES}
    list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("name", sorted(module_paths()))
def test_each_outside_thing_has_one_importer(name: str) -> None:
    foreign = {one for one in imports(name)[1] if name not in ONLY_IMPORTERS.get(one, {name})}
    assert not foreign, f"{name} must not import {', '.join(sorted(foreign))}"


@pytest.mark.parametrize("name", sorted(DECISIONS["decisions"]))
def test_decisions_are_pure(name: str) -> None:
    tree = ast.parse(module_paths()[name].read_text())
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


@pytest.mark.parametrize("verb", ["list", "stop", "logs", "why"])
def test_short_lived_verbs_load_little(verb: str, tmp_path: Path) -> None:
    code = f"import sys, dora_systemd.cli.main, dora_systemd.cli.{verb}; print(*sys.modules)"
    environment = {**os.environ, "PYTHONPATH": str(linked_package(tmp_path))}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stderr
    loaded = {module.partition(".")[0] for module in done.stdout.split()}
    assert not loaded & NOT_IN_SHORT_LIVED_VERBS


STARTS_PROGRAMS = {
    "trust.programs": "for others",
    "engine": "dora's, in a cell",
    "journalread": "journalctl",
    "managernode": "dora, as the caller",
    "cli.logs": "the caller's own pager",
    "relay": "itself, as the user of the dataflow",
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
ASKS_ROOTS_DORA = {"managerdoctor", "managerversion"}
"""They ask for a version only, of a dora that is root's when root asks."""


@pytest.mark.parametrize("name", [*USE_CASES["manager"], *GATEWAY["gateway"], *CLI["cli"]])
def test_dora_is_run_in_cells_only(name: str) -> None:
    tree = ast.parse(module_paths()[name].read_text())
    imported = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    allowed = {"dora_version"} if name in ASKS_ROOTS_DORA else set()
    assert not (imported & RUNS_DORA) - allowed
