"""The options of a runner, and the command line that stores them in ExecStart= of the unit.

There is no registry: `list` reads UUID and path of a dataflow from this command line. So this
module imports only what loads quickly.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.machines import Placed, parse_head, parse_machine, parse_placed
from dora_systemd.errors import DoraSystemdError, usage_error
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
DEFAULT_GRACE = 10 * SECOND
"""µs."""
_STOP_POST = str(PurePath(__file__).parents[2] / "stoppost.sh")


MODULES = {
    "black_box": "on_failure",
    "core_dumps": "rights",
    "cpu_limit": "limits",
    "cpu_weight": "limits",
    "cpus": "limits",
    "essential": "rights",
    "hot_reload": "reload",
    "ignore": "reload",
    "io_weight": "limits",
    "lock_memory": "rights",
    "log_rate_limit": "limits",
    "max_restart_delay": "restarts",
    "max_restarts": "restarts",
    "memory_high": "limits",
    "memory_limit": "limits",
    "needs": "needs",
    "nice": "limits",
    "notify": "owes",
    "on_failure": "on_failure",
    "oom_score_adjust": "rights",
    "owes": "owes",
    "record": "record",
    "replace": "reload",
    "restart_delay": "restarts",
    "restart_policy": "restarts",
    "restart_window": "restarts",
    "scheduling": "rights",
    "stop": "stops",
    "stop_limit": "stops",
    "swap_limit": "limits",
    "tasks_limit": "limits",
    "watch": "reload",
    "watchdog": "owes",
}
"""By key of each setting that a runner receives as text, its module in decisions/settings/."""


class SettingText(NamedTuple):
    """A value of a setting as text, or one of several for a repeatable kind."""

    node: str  # "" for the dataflow
    key: str  # of the settings file
    text: str  # from Kind.format


class RunnerOptions(NamedTuple):
    """All options of one runner; they do not change while its unit exists."""

    # name, uuid: of the dataflow
    name: str
    uuid: str
    dataflow: str  # absolute path of the descriptor
    working_directory: str  # absolute; nodes run there, and relative paths of nodes start there
    dora: str  # absolute path of the dora executable
    # absolute path of the nodes' virtual environment, or None for the interpreter on PATH
    venv: str | None = None
    uv: bool = False  # run Python nodes by uv, as `dora start --uv`
    debug: bool = False  # make topics inspectable, as `dora start --debug`
    allow_shell_nodes: bool = False  # allow nodes with `path: shell`
    grace: int = DEFAULT_GRACE  # µs for a node to exit after the stop request
    attached: bool = False  # the end of standard input requests a stop (`doractl run`)
    # overrides the descriptor's key of that name, unless None
    exit_when_nodes_finish: bool | None = None
    env_keys: tuple[str, ...] = ()  # names of the variables that override the descriptor's `env:`
    start_timeout: int = INFINITY  # µs for all nodes to become ready, or INFINITY
    settings: tuple[SettingText, ...] = ()  # see dora_systemd.decisions.settings
    placed: tuple[Placed, ...] = ()  # the nodes that run on other machines than the head
    # machine, head: on a member its name, and the host name of the head; else ""
    machine: str = ""
    head: str = ""
    addresses: tuple[str, ...] = ()  # with `link: direct` those of all machines, the own one first

    def __hash__(self) -> int:
        return hash(self.uuid)

    @property
    def hot_reload(self) -> bool:
        """Whether files are watched."""
        return self.has("hot_reload") and bool(self.of_dataflow("hot_reload"))

    @property
    def is_noticed(self) -> bool:
        """Whether something follows a failure: the command of on_failure, or a bundle."""
        has_box = self.has("black_box") and self.of_dataflow("black_box") is not None
        return has_box or self.has("on_failure")

    def has(self, key: str) -> bool:
        """Whether the dataflow or a node has a value of the setting."""
        assert key in MODULES
        return any(one.key == key for one in self.settings)

    def of_dataflow(self, key: str) -> Any:
        """The value of the setting for the dataflow, or its default.

        Raises DoraSystemdError for a text that is no value, as the next ones do.
        """
        setting = runner_setting(key)
        texts = [one.text for one in self.settings if one[:2] == ("", key)]
        return setting.read(texts) if texts else setting.default

    def by_node(self, key: str) -> Mapping[str, Any]:
        """The values that single nodes have of the setting, by node."""
        assert key in MODULES
        return _by_node(self, key)

    def with_value(self, key: str, value: Any) -> "RunnerOptions":
        """The options with another value of the setting for the dataflow."""
        texts = (SettingText("", key, text) for text in runner_setting(key).kind.format(value))
        return self._replace(settings=changed(self.settings, texts))

    def without(self, *keys: str) -> "RunnerOptions":
        """The options without values of these settings."""
        assert MODULES.keys() >= {*keys}
        return self._replace(settings=tuple(one for one in self.settings if one.key not in keys))

    def of_node(self, node: str, key: str) -> Any:
        """The value that a node has of the setting, or that of the dataflow."""
        own = self.by_node(key)
        return own[node] if node in own else self.of_dataflow(key)


@lru_cache(maxsize=64)
def _by_node(options: RunnerOptions, key: str) -> Mapping[str, Any]:
    # Cached: with many nodes, each start of one reads the values of all.
    texts: dict[str, list[str]] = {}
    for one in options.settings:
        if one.node and one.key == key:
            texts.setdefault(one.node, []).append(one.text)
    return {node: runner_setting(key).read(own) for node, own in texts.items()}


def changed(
    settings: Sequence[SettingText], changes: Iterable[SettingText]
) -> tuple[SettingText, ...]:
    """The settings, with all texts of those that `changes` has replaced."""
    added = tuple(changes)
    gone = {one[:2] for one in added}
    return (*(one for one in settings if one[:2] not in gone), *added)


def runner_setting(key: str) -> Any:
    """The Setting; its module is imported with the first value, because few dataflows have one."""
    module = import_module(f"dora_systemd.decisions.settings.{MODULES[key]}")
    return module.RUNNER_SETTINGS[key]


Parse = Callable[[str], Any]
Format = Callable[[Any], str]


class Option(NamedTuple):
    """One option of the command line, `--key=value`, or `--key` if it is a flag."""

    key: str
    field: str  # of RunnerOptions
    # the value of the field, from the texts of all arguments with this key
    parse: Callable[[list[str]], Any]
    format: Callable[[Any], list[str]]  # the inverse of parse: a text for each argument
    is_repeated: bool = False
    is_flag: bool = False


def _always(key: str, field: str, parse: Parse = str, to_text: Format = str) -> Option:
    return Option(key, field, lambda texts: parse(texts[0]), lambda value: [to_text(value)])


def _unless_default(key: str, field: str, parse: Parse = str, to_text: Format = str) -> Option:
    option, default = _always(key, field, parse, to_text), RunnerOptions._field_defaults[field]
    return option._replace(format=lambda value: [] if value == default else [to_text(value)])


def _each(key: str, field: str, parse: Parse = str, to_text: Format = str) -> Option:
    def format_all(values: Any) -> list[str]:
        return list(map(to_text, values))

    return Option(key, field, lambda texts: tuple(map(parse, texts)), format_all, True)


def _flag(key: str, field: str) -> Option:
    return Option(key, field, lambda _: True, lambda value: [""] * value, is_flag=True)


def _late(module: str, name: str) -> Callable[[Any], Any]:
    """A function of a module that few dataflows need: it is imported with the first value."""

    def call(value: Any) -> Any:
        return getattr(import_module(f"dora_systemd.decisions.{module}"), name)(value)

    return call


def parse_setting(text: str) -> SettingText:
    """Parse [NODE:]KEY=TEXT, the inverse of format_setting. Raises DoraSystemdError (USAGE)."""
    place, equals, value = text.partition("=")
    node, _, key = place.rpartition(":")
    if not equals or not key.isidentifier():
        raise _refusal(f"{quoted(text)} is not [NODE:]KEY=TEXT")
    if key not in MODULES:  # of a runner that another version has started
        raise _refusal(f"unknown setting {quoted(key)}")
    return SettingText(node, key, value)


def format_setting(given: SettingText) -> str:
    """Format as [NODE:]KEY=TEXT."""
    return f"{given.node}:{given.key}={given.text}" if given.node else f"{given.key}={given.text}"


_REQUIRED = ("name", "uuid", "working-directory", "dora")
_OPTIONS = (
    _always("name", "name", parse_name),
    _always("uuid", "uuid", parse_uuid),
    _always("working-directory", "working_directory"),
    _always("dora", "dora"),
    _always("grace-duration", "grace", parse_duration, format_duration),
    _unless_default("venv", "venv"),
    _unless_default("exit-when-nodes-finish", "exit_when_nodes_finish", parse_bool, format_bool),
    _unless_default("start-timeout", "start_timeout", parse_duration, format_duration),
    _each("env-key", "env_keys"),
    _each("set", "settings", parse_setting, format_setting),
    _each("placed", "placed", parse_placed, "=".join),
    _unless_default("machine", "machine", parse_machine),
    _unless_default("head", "head", parse_head),
    _each("address", "addresses", _late("machines.address", "parse_address")),
    _flag("uv", "uv"),
    _flag("debug", "debug"),
    _flag("allow-shell-nodes", "allow_shell_nodes"),
    _flag("attached", "attached"),
)
"""All options in the order of the command line, which ends with the path of the dataflow."""

_BY_KEY = {option.key: option for option in _OPTIONS}


def format_runner_argv(options: RunnerOptions) -> list[str]:
    """The arguments of `python3 -m dora_systemd.runner`, with readable long options."""
    arguments = []
    for one in _OPTIONS:
        texts = one.format(getattr(options, one.field))
        arguments += [f"--{one.key}" if one.is_flag else f"--{one.key}={text}" for text in texts]
    return [*arguments, options.dataflow]


def parse_runner_argv(argv: Sequence[str]) -> RunnerOptions:
    """The exact inverse of format_runner_argv.

    Raises DoraSystemdError (USAGE) for an unknown, repeated or missing option, and for a bad value.
    """
    dataflow = argv[-1] if argv else ""
    if not dataflow.startswith("/"):
        raise _refusal(f"no absolute path of a dataflow in {quoted(' '.join(argv))}")
    given: dict[str, list[str]] = {}
    for argument in argv[:-1]:
        option, text = _split(argument)
        if option.key in given and not option.is_repeated:
            raise _refusal(f"--{option.key} is given twice")
        given.setdefault(option.key, []).append(text)
    missing = [f"--{key}" for key in _REQUIRED if key not in given]
    if missing:
        raise _refusal(f"{' and '.join(missing)} missing")
    return _options(dataflow, given)


def _split(argument: str) -> tuple[Option, str]:
    key, equals, text = argument.removeprefix("--").partition("=")
    option = _BY_KEY.get(key)
    if not argument.startswith("--") or option is None or option.is_flag == bool(equals):
        raise _refusal(f"unknown argument {quoted(argument)}")
    return option, text


def _options(dataflow: str, given: dict[str, list[str]]) -> RunnerOptions:
    parsed = {one.field: one.parse(given[one.key]) for one in _OPTIONS if one.key in given}
    return RunnerOptions(dataflow=dataflow, **parsed)


def runner_command(python: str, options: RunnerOptions) -> list[str]:
    """ExecStart= of the unit. python: absolute path of the interpreter of dora-systemd."""
    return [*_python(python), *format_runner_argv(options)]


def post_command(python: str, options: RunnerOptions) -> list[str]:
    """ExecStopPost= of the unit, which writes the end to the journal if the runner was killed.

    It starts no Python if the runner exited by itself, because a restart would wait for that.
    """
    return ["/bin/sh", _STOP_POST, *_python(python, ".stop_post"), options.name, options.uuid]


def reload_command(python: str) -> list[str]:
    """ExecReload= of the unit, for `systemctl reload`."""
    return _python(python, ".reload.request")


def check_command(python: str, options: RunnerOptions) -> list[str]:
    """The command that checks whether a runner with these options would refuse to start."""
    return [*_python(python, ".check"), *format_runner_argv(options)]


def build_command(python: str, task: str) -> list[str]:
    """The command that builds a release. task: from decisions/releases/build.py."""
    return [*_python(python, ".build"), task]


def options_from_command(command: Sequence[str]) -> RunnerOptions:
    """The options in an ExecStart= of runner_command; raises DoraSystemdError for any other."""
    return parse_runner_argv(_arguments(command))


def known_options_from_command(command: Sequence[str]) -> RunnerOptions:
    """The options that this version knows, in an ExecStart= that another version has written.

    What is optional and unknown, or has a value that this version does not know, is left out.
    Raises DoraSystemdError for a command that is no runner's.
    """
    return known_options(_arguments(command))


def known_options(argv: Sequence[str]) -> RunnerOptions:
    """The options that this version knows, of a runner that another version has started.

    Raises DoraSystemdError as known_options_from_command().
    """
    return parse_runner_argv([*filter(_is_known, argv[:-1]), *argv[-1:]])


def _is_known(argument: str) -> bool:
    key = argument.removeprefix("--").partition("=")[0]
    try:
        option, text = _split(argument)
        option.parse([text])
    except DoraSystemdError:
        return key in _REQUIRED  # an error that the caller reports
    return True


def _arguments(command: Sequence[str]) -> Sequence[str]:
    if RUNNER_MODULE not in command:
        raise _refusal(f"{quoted(' '.join(command))} is not a runner of dora-systemd")
    return command[list(command).index(RUNNER_MODULE) + 1 :]


def _python(python: str, module: str = "") -> list[str]:
    # Ignore PYTHON* variables, and keep the working directory out of sys.path: a module of the
    # project must never replace one of the runner's.
    return [python, "-E", "-P", "-m", RUNNER_MODULE + module]


def _refusal(reason: str) -> DoraSystemdError:
    hint = (
        "the runner is started by doractl; if that was another version, stop the dataflow and "
        "start its file again"
    )
    return usage_error(f"cannot read the runner's command line: {reason}", hint)
