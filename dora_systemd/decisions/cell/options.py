"""The options of a runner, and the command line that stores them in ExecStart= of the unit.

There is no registry: `list` reads UUID and path of a dataflow from this command line. So this
module imports only what loads quickly.
"""

from collections.abc import Sequence
from pathlib import PurePath
from typing import NamedTuple

from dora_systemd.decisions.cell.hot_reload import (
    ARGUMENTS,
    DEFAULT_RELOAD,
    HotReload,
    format_reload,
    parse_reload,
)
from dora_systemd.decisions.cell.limits import NodeLimits, format_node_limits, parse_node_limits
from dora_systemd.decisions.cell.line_rates import UNLIMITED, RateLimits, format_rates, parse_rates
from dora_systemd.decisions.cell.restarts import DEFAULT, RestartPolicy, format_policy, parse_policy
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import parse_name, parse_uuid
from dora_systemd.values import (
    INFINITY,
    SECOND,
    format_bool,
    format_duration,
    parse_bool,
    parse_duration,
    quoted,
)

RUNNER_MODULE = "dora_systemd.runner"
POST_MODULE = "dora_systemd.runner.stop_post"
RELOAD_MODULE = "dora_systemd.runner.reload.request"
CHECK_MODULE = "dora_systemd.runner.check"
_STOP_POST = str(PurePath(__file__).parents[2] / "stoppost.sh")

_PYTHON_FLAGS = ("-E", "-P", "-m", RUNNER_MODULE)
"""Ignore PYTHON* variables, and keep the working directory out of sys.path: a module of the project
must never replace one of the runner's."""

_TEXTS = ("working-directory", "dora", "venv", "restart", "start-timeout")
_FLAGS = ("uv", "debug", "allow-shell-nodes", "attached", "hot-reload")
_REPEATED = ("env-key", "log-rate-limit", "node-limit", "node-restart", *ARGUMENTS)
_REQUIRED = ("name", "uuid", "working-directory", "dora")


class RunnerOptions(NamedTuple):
    """All options of one runner; they do not change while its unit exists.

    name, uuid: of the dataflow.
    dataflow: absolute path of the descriptor.
    working_directory: absolute; nodes run there, and relative paths of nodes start there.
    dora: absolute path of the dora executable.
    venv: absolute path of the nodes' virtual environment, or None for the interpreter on PATH.
    uv: run Python nodes by uv, as `dora start --uv`.
    debug: make topics inspectable, as `dora start --debug`.
    allow_shell_nodes: allow nodes with `path: shell`.
    grace: µs for a node to exit after the stop request.
    attached: the end of standard input requests a stop (`doractl run`).
    exit_when_nodes_finish: overrides the descriptor's key of that name, unless None.
    env_keys: names of the variables that override the descriptor's `env:`.
    log_rates: rate limits of log lines, see dora_systemd.decisions.cell.line_rates.
    node_limits: limits of single nodes.
    restart: policy of nodes without one in the descriptor.
    node_restarts: policies of single nodes.
    start_timeout: µs for all nodes to become ready, or INFINITY.
    reload: files that cause a reload, and how nodes are replaced.
    """

    name: str
    uuid: str
    dataflow: str
    working_directory: str
    dora: str
    venv: str | None = None
    uv: bool = False
    debug: bool = False
    allow_shell_nodes: bool = False
    grace: int = 10 * SECOND
    attached: bool = False
    exit_when_nodes_finish: bool | None = None
    env_keys: tuple[str, ...] = ()
    log_rates: RateLimits = UNLIMITED
    node_limits: tuple[NodeLimits, ...] = ()
    restart: RestartPolicy = DEFAULT
    node_restarts: tuple[tuple[str, RestartPolicy], ...] = ()
    start_timeout: int = INFINITY
    reload: HotReload = DEFAULT_RELOAD

    def __hash__(self) -> int:
        return hash(self.uuid)

    @property
    def hot_reload(self) -> bool:
        """Whether files are watched."""
        return self.reload.is_on


def format_runner_argv(options: RunnerOptions) -> list[str]:
    """The arguments of `python3 -m dora_systemd.runner`, with readable long options."""
    pairs = [
        ("name", options.name),
        ("uuid", options.uuid),
        ("working-directory", options.working_directory),
        ("dora", options.dora),
        ("grace-duration", format_duration(options.grace)),
    ]
    if options.venv is not None:
        pairs.append(("venv", options.venv))
    if options.exit_when_nodes_finish is not None:
        pairs.append(("exit-when-nodes-finish", format_bool(options.exit_when_nodes_finish)))
    if options.restart != DEFAULT:
        pairs.append(("restart", format_policy(options.restart)))
    if options.start_timeout != INFINITY:
        pairs.append(("start-timeout", format_duration(options.start_timeout)))
    pairs += [("env-key", key) for key in options.env_keys]
    pairs += [("log-rate-limit", text) for text in format_rates(options.log_rates)]
    pairs += [("node-limit", format_node_limits(one)) for one in options.node_limits]
    pairs += [
        ("node-restart", f"{node}:{format_policy(one)}") for node, one in options.node_restarts
    ]
    pairs += format_reload(options.reload)
    flags = [f"--{flag}" for flag in _FLAGS if getattr(options, flag.replace("-", "_"))]
    return [f"--{key}={value}" for key, value in pairs] + flags + [options.dataflow]


def parse_runner_argv(argv: Sequence[str]) -> RunnerOptions:
    """The exact inverse of format_runner_argv.

    Raises DoraSystemdError (USAGE) for an unknown, repeated or missing option, and for a bad value.
    """
    dataflow, given = argv[-1] if argv else "", argv[:-1]
    if not dataflow.startswith("/"):
        raise _refusal(f"no absolute path of a dataflow in {quoted(' '.join(argv))}")
    values: dict[str, str] = {}
    lists: dict[str, list[str]] = {key: [] for key in _REPEATED}
    for argument in given:
        key, value = _split(argument)
        if key in lists:
            lists[key].append(value)
        elif key in values:
            raise _refusal(f"--{key} is given twice")
        else:
            values[key] = value
    return _options(dataflow, values, lists)


def runner_command(python: str, options: RunnerOptions) -> list[str]:
    """ExecStart= of the unit. python: absolute path of the interpreter of dora-systemd."""
    return [python, *_PYTHON_FLAGS, *format_runner_argv(options)]


def post_command(python: str, options: RunnerOptions) -> list[str]:
    """ExecStopPost= of the unit, which writes the end to the journal if the runner was killed.

    It starts no Python if the runner exited by itself, because a restart would wait for that.
    """
    command = [python, *_PYTHON_FLAGS[:-1], POST_MODULE, options.name, options.uuid]
    return ["/bin/sh", _STOP_POST, *command]


def reload_command(python: str) -> list[str]:
    """ExecReload= of the unit, for `systemctl reload`."""
    return [python, *_PYTHON_FLAGS[:-1], RELOAD_MODULE]


def check_command(python: str, options: RunnerOptions) -> list[str]:
    """The command that checks whether a runner with these options would refuse to start."""
    return [python, *_PYTHON_FLAGS[:-1], CHECK_MODULE, *format_runner_argv(options)]


def options_from_command(command: Sequence[str]) -> RunnerOptions:
    """The options in an ExecStart= of runner_command; raises DoraSystemdError for any other."""
    if RUNNER_MODULE not in command:
        raise _refusal(f"{quoted(' '.join(command))} is not a runner of dora-systemd")
    return parse_runner_argv(command[list(command).index(RUNNER_MODULE) + 1 :])


def _split(argument: str) -> tuple[str, str]:
    key, equals, value = argument.removeprefix("--").partition("=")
    known = (*_REQUIRED, *_TEXTS, "grace-duration", "exit-when-nodes-finish", *_REPEATED)
    expected = known if equals else _FLAGS
    if not argument.startswith("--") or key not in expected:
        raise _refusal(f"unknown argument {quoted(argument)}")
    return key, value


def _options(dataflow: str, values: dict[str, str], lists: dict[str, list[str]]) -> RunnerOptions:
    missing = [f"--{key}" for key in _REQUIRED if key not in values]
    if missing:
        raise _refusal(f"{' and '.join(missing)} missing")
    exits = values.get("exit-when-nodes-finish")
    return RunnerOptions(
        name=parse_name(values["name"]),
        uuid=parse_uuid(values["uuid"]),
        dataflow=dataflow,
        env_keys=tuple(lists["env-key"]),
        log_rates=parse_rates(lists["log-rate-limit"]),
        node_limits=tuple(map(parse_node_limits, lists["node-limit"])),
        restart=parse_policy(values["restart"]) if "restart" in values else DEFAULT,
        node_restarts=tuple(map(_node_restart, lists["node-restart"])),
        start_timeout=parse_duration(values.get("start-timeout", "infinity")),
        grace=parse_duration(values.get("grace-duration", "10s")),
        exit_when_nodes_finish=None if exits is None else parse_bool(exits),
        working_directory=values["working-directory"],
        dora=values["dora"],
        venv=values.get("venv"),
        uv="uv" in values,
        debug="debug" in values,
        allow_shell_nodes="allow-shell-nodes" in values,
        attached="attached" in values,
        reload=parse_reload("hot-reload" in values, lists),
    )


def _node_restart(text: str) -> tuple[str, RestartPolicy]:
    # Times contain no colon, but node ids may contain one.
    node, _, policy = text.rpartition(":")
    return node, parse_policy(policy)


def _refusal(reason: str) -> DoraSystemdError:
    hint = "the runner is started by doractl, not by hand"
    return DoraSystemdError(
        f"cannot read the runner's command line: {reason}", hint, ExitCode.USAGE
    )
