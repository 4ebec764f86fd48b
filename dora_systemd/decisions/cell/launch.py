"""Rewrites the descriptor for dora: our launcher replaces every node's program.

dora's daemon only sees the launcher. So this module decides what a node executes, in the same way
as the daemon would. Nodes that dora must start itself stay unchanged.
"""

import shlex
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.environment import find_python
from dora_systemd.decisions.cell.log_backlog import with_bounds
from dora_systemd.decisions.cell.machines import placed_on
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import base_of, owes_of, policies_of
from dora_systemd.decisions.cell.restarts import (
    DEFAULT,
    HELD_KEYS,
    LATCH_KEYS,
    POLICY_KEYS,
    RestartPolicy,
    restart_of,
)
from dora_systemd.decisions.cell.uv import Read, find_lock, uv_project
from dora_systemd.decisions.descriptor.dataflow import BuildSession, Dataflow, expanded
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind, operator_file, split_arguments
from dora_systemd.decisions.watchdog.watchdogs import (
    ALL_NODES,
    OFF,
    Watchdogs,
    merge_watchdogs,
    watchdog_of,
)
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import INFINITY, SECOND, as_mapping, quoted, shell_word, shown

LAUNCHED = frozenset({NodeKind.PYTHON, NodeKind.EXECUTABLE, NodeKind.SHELL})
_BUILT = ("build", "git", "branch", "tag", "rev")
PROGRAM_KEYS = ("path", "args", *_BUILT)
"""Keys of a node that define its program; dora gets other values."""
PERL = "/usr/bin/perl"
"""The interpreter of launcher.pl."""
_LAUNCH = '$f = "$ENV{DORA_SYSTEMD_CELL}/launch/%s"; do $f; die "cannot run $f: $@$!\\n"'
"""The program of a node on another machine. Perl and no shell, as for launcher.pl."""
_UV_RUN = ("uv", "run")
_BUDGET = ("max_restarts", "restart_window")
DEFAULT_OPERATOR = "op"
"""dora's id of the operator in a node with a single operator."""


class LaunchPlan(NamedTuple):
    """The values to rewrite the descriptor with."""

    options: RunnerOptions
    launcher: str  # absolute path of launcher.pl
    search_path: str  # PATH of the nodes
    exists: Callable[[str], bool]  # whether a file with that absolute path exists
    read: Read  # the content of a file
    session: BuildSession = BuildSession()
    environment: Mapping[str, str] = {}  # for variables in `env:`


def launch_descriptor(dataflow: Dataflow, plan: LaunchPlan) -> dict[str, Any]:
    """The descriptor for dora. Raises DoraSystemdError (BAD_INPUT) for a node that cannot run."""
    document = dict(dataflow.raw)
    document["nodes"] = [_launch_node(node, dataflow.source, plan) for node in dataflow.nodes]
    if dataflow.env:
        # As for `dora start --env`: overrides the dataflow's env, but not that of a node.
        kept = {key: dataflow.env[key] for key in dataflow.env if key not in plan.options.env_keys}
        document["env"] = expanded(kept, plan.environment)
    if plan.options.debug:
        debug = as_mapping(document.get("debug"))
        document["debug"] = {**debug, "enable_debug_inspection": True}
    if plan.options.exit_when_nodes_finish is not None:
        document["exit_when_nodes_finish"] = plan.options.exit_when_nodes_finish
    return document


def is_launched(node: Node) -> bool:
    """Whether our launcher starts the node. With path_sha256 it does not: dora checks the file."""
    return node.kind in LAUNCHED and node.raw.get("path_sha256") is None


def has_pipes(node: Node) -> bool:
    """Whether the node's output goes through our pipes, and not through dora's log files."""
    return not node.keeps_output and has_launcher(node)


def has_launcher(node: Node) -> bool:
    """Whether launcher.pl runs before the node's program; for operators libexec/python runs it."""
    return is_launched(node) or node.kind is NodeKind.OPERATOR


def kinds(dataflow: Dataflow, plan: LaunchPlan) -> dict[str, str]:
    """Return how each node is started, in the terms of the live table."""
    return {node.id: _kind(node, plan) for node in dataflow.nodes}


def _kind(node: Node, plan: LaunchPlan) -> str:
    is_uv = plan.options.uv and node.kind is NodeKind.PYTHON and not _env_python(node, plan)
    return "uv" if is_uv else str(node.kind)


def _launch_node(node: Node, source: str, plan: LaunchPlan) -> dict[str, Any]:
    raw = {**node.raw, **_restart_keys(node, plan.options)}
    if node.env:
        raw["env"] = expanded(node.env, plan.environment)
    if raw.get("restart_policy", "never") == "never" and is_launched(node):
        raw |= _keys_of_kept(node.id, plan.options)
    if machine := placed_on(plan.options.placed, node.id):
        return _placed_node(node.id, raw, machine)
    if isinstance(deploy := raw.get("deploy"), Mapping):  # this machine, whose daemon has no name
        raw["deploy"] = {**deploy, "machine": None, "labels": {}}
    if node.kind is NodeKind.OPERATOR:
        return _launch_operators(node, raw, plan.options.working_directory)
    if not has_pipes(node):
        raw = with_bounds(raw)
    if not is_launched(node):
        return raw
    kept = {key: value for key, value in raw.items() if key not in PROGRAM_KEYS}
    if isinstance(kept.get("deploy"), Mapping):
        kept["deploy"] = {**kept["deploy"], "working_dir": None}
    return {**kept, "path": PERL, "args": shlex.join(launcher_words(node, source, plan))}


def launcher_words(node: Node, source: str, plan: LaunchPlan) -> list[str]:
    """launcher.pl and its arguments for a node. Raises DoraSystemdError if it cannot run."""
    output = ("keep" if node.keeps_output else "pipe") + _notify_words(node, plan)
    directory = _directory(node, source, plan)
    command = [*_without_core_dump(node.id, plan.options), *_command(node, directory, source, plan)]
    return [plan.launcher, node.id, directory, output, *command]


def _without_core_dump(node: str, options: RunnerOptions) -> Sequence[str]:
    """The program that keeps the kernel from writing the memory of the node, see prlimit(1)."""
    keeps = options.by_node("core_dumps").get(node, True)
    return () if keeps else ("/usr/bin/prlimit", "--core=0:0")


def _notify_words(node: Node, plan: LaunchPlan) -> str:
    """ ":USEC" if the node has a notify socket, 0 without a watchdog.

    The program of a node whose process is uv or a shell has another pid: ":any" is no WATCHDOG_PID.
    """
    limit = watchdog_of(watchdogs_of(plan.options), node.id)
    if not limit:
        return ""
    is_wrapped = plan.options.uv or node.kind is NodeKind.SHELL
    return f":{limit if limit < INFINITY else 0}" + (":any" if is_wrapped else "")


@lru_cache(maxsize=4)
def watchdogs_of(options: RunnerOptions) -> Watchdogs:
    """Which nodes have one: none of those of other machines. Raises DoraSystemdError."""
    if not any(map(options.has, ("watchdog", "notify", "stop"))):
        return {}
    limits = {ALL_NODES: options.of_dataflow("watchdog"), **options.by_node("watchdog")}
    # A node with a time to stop can extend it.
    timed = {node: True for node, one in options.by_node("stop").items() if one.within}
    sockets = {ALL_NODES: options.of_dataflow("notify"), **timed, **options.by_node("notify")}
    found = merge_watchdogs(limits, sockets)
    away = [one.node for one in options.placed if one.machine != options.machine]
    return {**found, **dict.fromkeys(away, OFF)} if ALL_NODES in found else found


def _keys_of_kept(node: str, options: RunnerOptions) -> Mapping[str, Any]:
    """The restart keys of a node without restarts that dora must not give up at once."""
    if options.hot_reload:
        return HELD_KEYS
    return LATCH_KEYS if node in options.by_node("needs") else {}


def _restart_keys(node: Node, options: RunnerOptions) -> dict[str, Any]:
    """The restart keys of the node: from the settings for it, its own, or the dataflow's."""
    own = policies_of(options).get(node.id)
    given = {key for owner, key, _ in options.settings if owner == node.id}
    if own and ("restart_policy" in given or node.restart_policy in ("", "never")):
        return own.dora_keys()
    if node.restart_policy:
        return _with_budget(_restart_bounds(node), own, given) if own else _restart_bounds(node)
    # dora does not restart nodes made of operators, nor dynamic nodes.
    is_restarted = node.kind not in (NodeKind.OPERATOR, NodeKind.DYNAMIC)
    policy = base_of(restart_of(options), owes_of(options), node.id)
    if not is_restarted or policy.policy == "no":
        return {}
    # Without a policy of the dataflow it restarts by its owes alone.
    kept = node.backoff if restart_of(options).policy == "no" else {}
    return {**policy.dora_keys(), **{key: kept[key] for key in _BUDGET if key in kept}}


def idle_budgets(dataflow: Dataflow, options: RunnerOptions) -> Iterator[str]:
    """A warning for each node with settings about restarts that dora never restarts."""
    for node in dataflow.nodes:
        given = [key for owner, key, _ in options.settings if owner == node.id]
        bounds = next((key for key in given if key in POLICY_KEYS[1:]), "")
        policy = _restart_keys(node, options).get("restart_policy", node.restart_policy)
        if bounds and policy in ("", "never"):
            yield f"{bounds} of the node {node.id} has no effect: its restart_policy is no"


def _with_budget(
    bounds: Mapping[str, Any], own: RestartPolicy, given: Container[str]
) -> dict[str, Any]:
    """The keys of a node that keeps the policy in the descriptor, with the settings for it.

    given: the keys of the settings for it, which are dora's.
    """
    if not bounds:
        return {}
    keys = own._replace(policy="always").dora_keys()
    found = {**bounds, **{key: keys.get(key) for key in POLICY_KEYS[1:] if key in given}}
    if "max_restarts" not in given:  # that of the descriptor may be large
        found["restart_delay"] = max(found["restart_delay"], DEFAULT.delay / SECOND)
    return {**found, "max_restart_delay": max(found["restart_delay"], found["max_restart_delay"])}


def _restart_bounds(node: Node) -> dict[str, Any]:
    """Limits for the restart delays of a node, for those keys that the descriptor lacks."""
    if node.restart_policy not in ("on-failure", "always"):
        return {}
    shortest, longest = DEFAULT.delay / SECOND, DEFAULT.max_delay / SECOND
    delay = max(_seconds(node, "restart_delay", shortest), shortest)
    longest = max(_seconds(node, "max_restart_delay", longest), delay)
    return {"restart_delay": delay, "max_restart_delay": longest}


def _seconds(node: Node, key: str, default: float) -> float:
    value = node.backoff.get(key, default)
    return float(value) if isinstance(value, int | float) else default


def _directory(node: Node, source: str, plan: LaunchPlan) -> str:
    if node.git:
        if node.id not in plan.session.directories:
            reason = "it comes from git and was not built"
            raise _refusal(source, node, reason, _build_hint(source, plan))
        return plan.session.directories[node.id]
    return str(PurePath(plan.options.working_directory, node.working_directory))


def _command(node: Node, directory: str, source: str, plan: LaunchPlan) -> list[str]:
    if node.kind is NodeKind.SHELL:
        if not plan.options.allow_shell_nodes:
            hint = "start with --allow-shell-nodes if you trust the dataflow"
            raise _refusal(source, node, "shell nodes are not allowed by default", hint)
        return ["sh", "-c", node.args]
    program = _find(node, directory, source, plan)
    arguments = _split(node, source)
    if node.kind is NodeKind.EXECUTABLE:
        return [*(_UV_RUN if plan.options.uv else ()), program, *arguments]
    return [*_interpreter(node, plan), "-u", program, *arguments]


def _split(node: Node, source: str) -> list[str]:
    try:
        return split_arguments(node.args)
    except ValueError as error:
        raise _refusal(source, node, f"its args: {error}", "quote args as in a shell") from error


def sources(dataflow: Dataflow, plan: LaunchPlan) -> dict[str, dict[str, str]]:
    """The files that each node is started from, absolute, by operator id or ""."""
    return {node.id: dict(_node_sources(node, dataflow.source, plan)) for node in dataflow.nodes}


def _node_sources(node: Node, source: str, plan: LaunchPlan) -> Iterator[tuple[str, str]]:
    if node.kind in (NodeKind.PYTHON, NodeKind.EXECUTABLE):
        yield "", _find(node, _directory(node, source, plan), source, plan)
    if node.kind is NodeKind.OPERATOR:
        raw = _with_absolute_operators(dict(node.raw), plan.options.working_directory)
        for operator in (raw.get("operator"), *(raw.get("operators") or ())):
            if isinstance(file := operator_file(operator), str):
                yield str(operator.get("id") or DEFAULT_OPERATOR), file


def _find(node: Node, directory: str, source: str, plan: LaunchPlan) -> str:
    places = [directory, *_uv_places(directory, plan), *filter(None, plan.search_path.split(":"))]
    for place in places:
        path = str(PurePath(place, node.path))
        if plan.exists(path):
            return path
    reason = f"its path {quoted(node.path)} is neither in {directory} nor in PATH"
    raise _refusal(source, node, reason, _hint(node, directory, source, plan))


def _hint(node: Node, directory: str, source: str, plan: LaunchPlan) -> str:
    """Return the hint for a missing program."""
    if node.build:
        return _build_hint(source, plan)
    correct, first = "correct the path of the node", ""
    places = dict.fromkeys((directory, plan.options.working_directory))
    if "/" in node.path:
        return correct
    # It may be a console script of a package.
    if find_lock(places, plan.exists):
        first = _build_hint(source, plan)
    elif projects := [one for one in places if plan.exists(f"{one}/pyproject.toml")]:
        first = f"run `uv sync` in {shown(projects[0])} first"
    return f"{first}, or {correct}" if first else correct


def _build_hint(source: str, plan: LaunchPlan) -> str:
    uv = "--uv " if plan.options.uv else ""
    return f"run `doractl build {uv}{shell_word(source)}` first"


def _uv_places(directory: str, plan: LaunchPlan) -> list[str]:
    """Return where `uv run which` searches first, by which dora finds programs."""
    project = uv_project(directory, plan.read) if plan.options.uv else None
    return [str(PurePath(project, ".venv", "bin"))] if project else []


def _interpreter(node: Node, plan: LaunchPlan) -> list[str]:
    if not plan.options.uv:
        return [python_of(plan)]
    own = _env_python(node, plan)
    return [own] if own else [*_UV_RUN, "python"]


def _env_python(node: Node, plan: LaunchPlan) -> str | None:
    if not plan.options.uv or node.id not in plan.session.envs:
        return None
    python = str(PurePath(plan.session.envs[node.id], "bin", "python"))
    return python if plan.exists(python) else None


def python_of(plan: LaunchPlan) -> str:
    """The interpreter of the nodes."""
    return find_python(plan.options.venv, plan.search_path, plan.exists)


def _launch_operators(node: Node, raw: dict[str, Any], directory: str) -> dict[str, Any]:
    """Dora takes the limits of log files from the operators of such a node only."""
    raw = _with_absolute_operators(raw, directory)
    return raw if has_pipes(node) else _for_operators(raw, with_bounds)


def _with_absolute_operators(raw: dict[str, Any], directory: str) -> dict[str, Any]:
    """Make paths of operators absolute: dora would resolve them in its own working directory."""
    return _for_operators(raw, lambda operator: _absolute_operator(operator, directory))


def _for_operators(raw: dict[str, Any], change: Callable[[Any], Any]) -> dict[str, Any]:
    """The node, with a change to each of its operators."""
    if isinstance(raw.get("operator"), Mapping):
        raw["operator"] = change(raw["operator"])
    if isinstance(raw.get("operators"), list):
        raw["operators"] = [change(one) for one in raw["operators"]]
    return raw


def _absolute_operator(operator: Any, directory: str) -> Any:
    if not isinstance(operator, Mapping):
        return operator
    changed = dict(operator)
    for key in ("python", "shared-library"):
        value = changed.get(key)
        if isinstance(value, str):
            changed[key] = _absolute(value, directory)
        elif isinstance(value, Mapping) and isinstance(value.get("source"), str):
            changed[key] = {**value, "source": _absolute(value["source"], directory)}
    return changed


def _absolute(path: str, directory: str) -> str:
    return path if "://" in path else str(PurePath(directory, path))


def _refusal(source: str, node: Node, reason: str, hint: str) -> DoraSystemdError:
    return bad_input(f"cannot start {source}: node {node.id}: {reason}", hint)


def _placed_node(node: str, raw: Mapping[str, Any], machine: str) -> dict[str, Any]:
    """Return the definition of a node on another machine; with_works() fills in the directory.

    The file launch/NODE in the cell of that machine contains the command line of the node.
    """
    kept = {key: value for key, value in raw.items() if key not in _BUILT}
    deploy = {"machine": machine, "working_dir": None}
    return {**kept, "deploy": deploy, "path": PERL, "args": shlex.join(["-e", _LAUNCH % node])}
