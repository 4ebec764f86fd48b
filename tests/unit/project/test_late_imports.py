"""Imports stand at the top of a module. The ones inside functions pay, and each says why.

An import compiles no regular expressions: a start imports more of them than it uses.
"""

import ast
from collections.abc import Iterator

from tests.unit.checkout import module_paths, nodes_of, tree_of

LATE = {
    "click takes 35 ms: no --version, and no usual list, waits for it": {
        "cli.main": {"cli.group", "cli.completion", "cli.listing"},
    },
    "a list of nothing, or of what has this version's Description=, does without it": {
        "verbs.facts.cells": {"decisions.cell.options"},
    },
    "the gateway does without it until somebody looks at releases or bundles, or rolls back": {
        "gateway.live.about": {
            *("decisions.views.releases", "verbs.releases.listing"),
            *("decisions.bundles.table", "verbs.bundles.listing"),
        },
        "gateway.routes": {"verbs.bundles.listing", "gateway.live.pictures"},
        "gateway.live.actions": {
            *("verbs.releases.listing", "verbs.releases.rollback", "verbs.bundles.write"),
        },
    },
    "most notices come without a bundle, which needs all that doctor checks": {
        "verbs.notice.send": {"verbs.bundles.recording", "verbs.bundles.write"},
    },
    "OpenSSL, and every compressor: whoever only counts bundles writes none": {
        "adapters.bundles.store": {"hashlib", "tarfile"},
    },
    "OpenSSL, and every compressor: whoever lists releases compares and receives none": {
        "adapters.releases.store": {"concurrent.futures", "hashlib"},
        "verbs.releases.listing": {"adapters.releases.transfer"},
    },
    "a report of what this machine knows reads no bundle": {
        "cli.verbs.look.why": {"verbs.bundles.listing"},
    },
    "it imports logging, and most commands run nothing in a thread": {
        "adapters.host.process": {"concurrent.futures"},
    },
    "it has all properties, and verbs that read processes judge no systemd": {
        "decisions.views.diagnosis": {"decisions.unit.systemd_versions"},
    },
    "only doctor, up and destroy list processes": {
        "adapters.host.process_table": {"decisions.views.diagnosis"},
    },
    "a restart of what runs resolves no settings, and does not read the journal": {
        "verbs.start.restart_ended": {
            *("adapters.journal.reader", "decisions.logs.query"),
            "decisions.settings.resolve",
        },
    },
    "only some verbs wrap, and only on a terminal": {
        "terminal_text": {"textwrap"},
    },
    "the table of list does without it": {
        "cli.listing": {
            *("verbs.list", "verbs.facts.ended", "verbs.facts.list"),
            *("decisions.views.details", "decisions.views.objects"),
            *("decisions.views.selection", "cli.terminal", "verbs.facts.selector"),
            *("adapters.cgroup.groups", "decisions.gateway.place"),
        },
        "names": {"difflib"},
        "cli.edge": {"decisions.views.objects"},
    },
    "shutil imports every compressor: only a terminal has a width; a pipe hears of machines": {
        "cli.terminal": {"shutil", "decisions.cell.machines"},
    },
    "a start that succeeds has no last words, most follow no log and copy no files": {
        "cli.verbs.run.start": {
            *("cli.foreground", "cli.verbs.run.restart", "verbs.start.run", "verbs.machines.push"),
        },
    },
    "it reads projects: most verbs for other hosts do not": {
        "cli.remote.dispatch": {"cli.remote.rollout"},
    },
    "a restart of what runs makes no plan": {
        "cli.verbs.run.restart": {"decisions.why.remedies", "verbs.start.start", "verbs.why"},
    },
    "only a wrong command line needs a similar command, or the names of dataflows": {
        "cli.group": {"difflib", "adapters.bus.systemd", "verbs.facts.cells"},
    },
    "a Tab after a verb or an option does not ask for a dataflow": {
        "cli.completion": {
            *("verbs.facts.cells", "verbs.facts.list", "verbs.facts.selector"),
            *("verbs.releases.listing", "verbs.remote.hosts", "verbs.bundles.listing"),
        },
    },
    "seldom: what is not in systemd, has restarted, was killed, or enabled while it ran": {
        "verbs.facts.budget": {"adapters.journal.reader"},
        "verbs.facts.ended": {
            *("decisions.why.postmortem", "decisions.why.verdict", "verbs.facts.lives"),
        },
        "verbs.facts.recorded": {"adapters.bus.systemd", "verbs.facts.cells"},
        "verbs.facts.selector": {"verbs.facts.ended"},
        "verbs.list": {"verbs.facts.ended", "verbs.start.restart_ended"},
        "runner.nodes.lost_entries": {"adapters.journal.reader"},
        "verbs.stop": {
            *("adapters.host.unit_files", "adapters.journal.reader", "decisions.unit.file"),
            *("verbs.start.start", "verbs.start.enable"),
        },
    },
    "pydantic: only a settings file needs it": {
        "decisions.settings.resolve": {"decisions.settings.schema"},
    },
    "the runner knows the class, and the settings are read by a child": {
        "runner.reload.settings_file": {
            *("decisions.settings.differences", "decisions.settings.resolve"),
        },
    },
    "YAML, and every compressor: most who read a file need neither": {
        "adapters.host.files": {"yaml", "adapters.host.yaml_loader"},
        "cli.verbs.look.logs": {"verbs.follow", "cli.remote.machines", "shutil"},
    },
    "uv only": {"decisions.cell.uv": {"tomllib"}},
    "JSON is for programs, and most who do something are people": {
        "cli.parameters": {"decisions.views.objects"},
        "decisions.views.outcome": {"decisions.views.objects"},
    },
    "most dataflows owe nothing, wait for nothing, never restarted, and run on one machine": {
        "adapters.dora.probe": {"decisions.recorder.record"},
        "adapters.dora.preparation": {
            *("adapters.dora.probe", "decisions.machines.part", "decisions.settings.runner"),
        },
        "runner.main": {
            "runner.cell.notices",
            *("runner.machines.head", "runner.machines.member", "runner.needs"),
            *("runner.owes.watch", "runner.recorder.keep"),
        },
        "verbs.facts.reading": {
            *("decisions.machines.usage", "decisions.owes.probe"),
            *("verbs.facts.held", "verbs.facts.budget", "decisions.cell.owes"),
        },
    },
    "few stops have an order, and few nodes start containers": {
        "runner.cell.machine_role": {"runner.cell.node_stops"},
        "runner.machines.head": {"runner.machines.order"},
        "runner.nodes.groups": {"adapters.host.clients"},
    },
    "a program of its own: it makes room first, and it runs with the Python of the nodes": {
        "runner.owes.listen": {"dora"},
        "runner.recorder.record": {"dora", "pyarrow", "decisions.recorder.writer"},
    },
    "most dataflows run on one machine and have no releases, and most links are not lost": {
        "cli.foreground": {"verbs.facts.machines", "verbs.remote.attached"},
        "verbs.start.where": {
            *("adapters.host.addresses", "adapters.host.watch"),
            "decisions.machines.spread",
        },
        "verbs.why": {
            *("verbs.facts.machines", "verbs.releases.listing", "verbs.start.restart_ended"),
        },
        "verbs.start.unit": {"adapters.host.watch", "decisions.machines.link_unit"},
        "verbs.start.start": {"decisions.machines.link_unit"},
        "verbs.start.enable": {"decisions.machines.link_unit"},
        "link.talk": {"link.end_reason"},
        "link.relay": {"signal"},
    },
    "in the child that reads a project, whose interpreter does not look for it": {
        "trust.courier": {"pathspec"},
    },
    "few verbs start programs of another user": {
        "trust.programs": {"ctypes"},
    },
    "hot reload only": {
        "adapters.host.watch": {"watchfiles"},
        "decisions.reload.watch_rules": {"pathspec"},
        "verbs.reload": {"adapters.host.watch"},
    },
    "a list without dataflows has no node": {
        "decisions.views.facts": {
            *("decisions.cell.machines", "decisions.cell.status"),
        },
    },
    "most nodes have pipes and no notify socket, and no node has rights or owes anything": {
        "runner.nodes.nodes": {"runner.nodes.watchdog", "runner.nodes.log_changes"},
        "runner.cell.dialogue": {"runner.nodes.watchdog"},
        "verbs.facts.list": {
            *("decisions.watchdog.messages", "decisions.cell.owes", "decisions.cell.rights"),
        },
    },
    "asyncio and WebSockets: of all verbs, a few need one of them": {
        "verbs.node": {"adapters.dora.control", "adapters.runner_socket.relay"},
        "adapters.dora.control": {"adapters.dora.websocket"},
    },
    "a library of systemd that may be missing: its error comes when it is used": {
        "adapters.bus.connection": {"adapters.bus.library"},
        "adapters.host.notify": {"systemd.daemon"},
    },
    "the coordinator boots while the rest of the runner is imported": {
        "runner.__main__": {
            *("adapters.dora.check", "runner.cell.boot", "runner.main"),
            "runner.machines.boot",
        },
        "runner.cell.begin": {"adapters.dora.command", "runner.nodes.rights"},
        "runner.cell.restarts": {
            *("adapters.host.process", "adapters.host.files", "adapters.host.notify"),
            *("adapters.host.unit_files", "decisions.cell.status", "asyncio"),
            "decisions.cell.black_box",
        },
    },
    "systemd runs it after every life, and it has nothing to do unless the runner was killed": {
        "runner.stop_post": {
            "adapters.journal.note",
            "adapters.journal.socket",
            "adapters.logs.jsonl",
            "adapters.logs.pipes",
            "asyncio",
        },
    },
}
"""By reason and module: what it imports inside functions. Without dora_systemd. for our own."""

COMPILING = {
    "adapters.host.real_time",
    "adapters.host.yaml_loader",
    "decisions.gateway.request",
    "decisions.logs.terminal",
    "decisions.machines.member",
    "decisions.releases.build",
    "decisions.releases.manifest",
    "decisions.resources.host",
    "decisions.views.upkeep",
    "decisions.why.stack",
}
"""Modules that few commands import, which then use the expressions."""


def imported(node: ast.AST) -> set[str]:
    """The modules that a statement imports."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    module = f"{node.module}".removeprefix("dora_systemd.")
    below = {f"{module}.{alias.name}" for alias in node.names} & module_paths().keys()
    return below or {module}


def late_imports(name: str) -> set[str]:
    """What the functions of a module import."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    functions = [node for node in nodes_of(name) if isinstance(node, kinds)]
    return {one for function in functions for node in ast.walk(function) for one in imported(node)}


def test_imports_inside_functions_have_a_reason() -> None:
    found = {name: late for name in module_paths() if (late := late_imports(name))}
    allowed = {name: late for group in LATE.values() for name, late in group.items()}
    assert sum(map(len, LATE.values())) == len(allowed), "a module has one reason"
    assert found == allowed


def compiled_at_import(name: str) -> Iterator[ast.Call]:
    """The calls of re.compile() outside functions."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    statements = (one for one in tree_of(name).body if not isinstance(one, functions))
    for node in (node for one in statements for node in ast.walk(one)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "re.compile":
            yield node


def test_an_import_compiles_no_expression() -> None:
    # Instead: NAME = r"...", and re.fullmatch(NAME, text), which keeps what it has compiled.
    assert {name for name in module_paths() if any(compiled_at_import(name))} == COMPILING
