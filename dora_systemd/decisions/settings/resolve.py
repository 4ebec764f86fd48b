"""Resolves the value of each setting, and turns settings into the options of the runner.

A value is from flags, variables, settings files, or the default.
"""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import PurePath
from typing import Any, TypeVar, cast

from dora_systemd.decisions.cell.options import (
    MODULES,
    RunnerOptions,
    SettingText,
    changed,
    parse_setting,
)
from dora_systemd.decisions.cell.owes import RESTART, policies_of
from dora_systemd.decisions.descriptor.json_size import check_json, refusal
from dora_systemd.decisions.settings.kinds import Base, Setting, texts_of
from dora_systemd.decisions.settings.nodes import NODES, Nodes
from dora_systemd.decisions.settings.owes import OWES
from dora_systemd.decisions.settings.reload import HOT_RELOAD, IGNORE, WATCH
from dora_systemd.decisions.settings.restarts import POLICY_SETTINGS, RESTART_POLICY, START_TIMEOUT
from dora_systemd.decisions.settings.table import (
    ALLOW_SHELL_NODES,
    DEBUG,
    EXIT_WHEN_NODES_FINISH,
    GRACE_DURATION,
    SETTINGS,
    UV,
)
from dora_systemd.errors import DoraSystemdError, WrongKey, bad_input, usage_error
from dora_systemd.values import shown

T = TypeVar("T")
Given = tuple[str, Any]
"""A source's name for messages, and its value."""

DEFAULT_SOURCE = "default"
SET = "set"
"""The flag by which a head passes settings to its members, `--set [NODE:]KEY=TEXT`."""

MAX_JSON = 1024 * 1024
"""Maximum bytes of a settings file with anchors expanded."""


@dataclass(frozen=True)
class Settings:
    """The values of all settings and their sources; `settings[VENV]` has the type of VENV."""

    values: Mapping[str, Any]
    # by name of the setting: a flag, a variable's name, a file's path or DEFAULT_SOURCE
    sources: Mapping[str, str]
    table: Sequence[Setting[Any]] = field(default=SETTINGS, repr=False)  # the existing settings
    # in system scope, environment files that only others than root name
    lent: frozenset[str] = frozenset()
    passed: tuple[SettingText, ...] = ()  # on a member, from the head
    flagged_nodes: Nodes = field(default_factory=dict)  # the values of single nodes from --node

    def __getitem__(self, setting: Setting[T]) -> T:
        return cast(T, self.values[setting.name])

    def source(self, setting: Setting[Any]) -> str:
        """The source of the value of `setting`, for messages and `show`."""
        return self.sources[setting.name]

    def is_in_file(self, setting: Setting[Any]) -> bool:
        """Whether a settings file gives the value of `setting`: its source is an absolute path."""
        return self.source(setting).startswith("/")

    def is_given(self, setting: Setting[Any]) -> bool:
        """Whether anything but the default gives a value for `setting`."""
        return self.sources[setting.name] != DEFAULT_SOURCE

    @property
    def nodes(self) -> Nodes:
        """The values of single nodes."""
        return cast(Nodes, self.values.get(NODES, {}))

    def by_node(self, setting: Setting[T]) -> dict[str, T]:
        """The values of `setting` for single nodes, by node id."""
        name = setting.name
        return {node: values[name] for node, values in self.nodes.items() if name in values}


def resolve_settings(
    flags: Mapping[str, object],
    environment: Mapping[str, str],
    files: Sequence[tuple[str, object]],
    table: Sequence[Setting[Any]] = SETTINGS,
) -> Settings:
    """Every setting from flags, DORA_* variables, files (highest precedence first) or its default.

    flags: raw values by name of the setting: a text, a sequence of texts, a boolean, or None and ()
    for a flag that was not given. environment: the caller's variables. files: pairs of the file's
    absolute path and its document, None if empty; relative paths in a file start at its directory.
    Variables of `env` merge key by key; lists of files and of properties are joined, highest
    precedence last. Raises DoraSystemdError: USAGE for flags and variables, BAD_INPUT for files.
    """
    documents = [(source, check_document(source, document, table)) for source, document in files]
    passed = tuple(parse_setting(text) for text in texts_of(flags.get(SET) or ()))
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    flagged: Nodes = {}
    for setting in table:
        of_flag = [*_from_flag(setting, flags)]
        given = [
            *_from_files(setting, reversed(documents)),
            *_from_variable(setting, environment),
            *of_flag,
        ]
        sources[setting.name], values[setting.name] = _merged(setting, given)
        if setting.name == NODES and of_flag:
            flagged = of_flag[0][1]
    return Settings(values, sources, table, passed=passed, flagged_nodes=flagged)


def given_texts(
    flags: Mapping[str, object],
    environment: Mapping[str, str],
    directory: PurePath,
    recorded: Mapping[str, object] | None = None,
) -> dict[str, str | list[str]]:
    """Return what flags and variables set, as flags that are valid in every directory.

    directory: where relative paths start. recorded: flags of lower precedence, of an earlier call.
    Raises DoraSystemdError (USAGE) as resolve_settings().
    """
    found: dict[str, str | list[str]] = {}
    for setting in SETTINGS:
        given = [*_from_flag(setting, recorded or {})]
        given += _from_variable(setting, environment, directory)
        given += _from_flag(setting, flags, directory)
        if given:
            texts = list(setting.kind.format(_merged(setting, given)[1]))
            many = _last(texts) if recorded else texts
            found[setting.name] = many if setting.kind.is_repeatable else " ".join(texts)
    return found


def _last(texts: Iterable[str]) -> list[str]:
    """The texts, each at its last place only: the order of properties counts."""
    return [*dict.fromkeys(reversed([*texts]))][::-1]


def is_given(value: object) -> bool:
    """Whether a raw value of a flag is one, see resolve_settings()."""
    return value not in (None, ())


def check_document(
    source: str, document: object, table: Sequence[Setting[Any]] = SETTINGS
) -> Mapping[str, Any]:
    """The settings file `document` without empty keys.

    Raises DoraSystemdError (BAD_INPUT) with file and key if it is not a mapping, a key is unknown,
    or a value has the wrong type.
    """
    # Imported late: only settings files need pydantic.
    from dora_systemd.decisions.settings.schema import validate_settings, validation_error

    if document is None:
        return {}
    if not isinstance(document, dict):
        raise refusal(source, "it is not a mapping", "a settings file is a mapping, KEY: VALUE")
    check_json(document, source, MAX_JSON)
    try:
        validate_settings(document, table)
    except ValueError as error:
        raise validation_error(source, error, table) from error
    return {key: value for key, value in document.items() if value is not None}


def _from_flag(
    setting: Setting[Any], flags: Mapping[str, object], base: Base = None
) -> Iterator[Given]:
    value = flags.get(setting.name)
    if is_given(value):
        yield setting.flags[0], _parsed(setting, value, setting.flags[0], base)


def _from_variable(
    setting: Setting[Any], environment: Mapping[str, str], base: Base = None
) -> Iterator[Given]:
    # For shells, an empty variable usually means unset.
    value = environment.get(setting.variable, "") if setting.variable else ""
    if value:
        yield setting.variable, _parsed(setting, value, setting.variable, base)


def _from_files(
    setting: Setting[Any], documents: Iterable[tuple[str, Mapping[str, Any]]]
) -> Iterator[Given]:
    for source, document in documents:
        if setting.name in document:
            yield source, _parsed_in_file(setting, document[setting.name], source)


def _parsed_in_file(setting: Setting[Any], value: object, source: str) -> Any:
    base = PurePath(source).parent
    try:
        return setting.kind.parse(value, base if base.is_absolute() else None)
    except DoraSystemdError as error:
        place = (setting.name, *_inner(error))
        message = f"{error.message} ({'.'.join(map(shown, place))} in {shown(source)}"
        raise WrongKey(message, error.hint, source, place, end=")") from error


def _inner(error: DoraSystemdError) -> Sequence[str]:
    return error.place if isinstance(error, WrongKey) else ()


def _parsed(setting: Setting[Any], value: object, where: str, base: Base) -> Any:
    try:
        return setting.kind.parse(value, base)
    except DoraSystemdError as error:
        place = " ".join(filter(None, (where, ":".join(_inner(error)))))
        raise usage_error(f"{error.message} ({place})", error.hint) from error


def _merged(setting: Setting[Any], given: Sequence[Given]) -> Given:
    """The joined value of all sources, highest precedence last, and its source."""
    if not given:
        return DEFAULT_SOURCE, setting.default
    merge = setting.kind.merge
    if merge is None:
        return given[-1]
    names = ", ".join(source for source, _ in reversed(given))
    return names, reduce(merge, (value for _, value in given))


def with_settings(options: RunnerOptions, settings: Settings) -> RunnerOptions:
    """The options, with those that are settings. Raises DoraSystemdError."""
    given = options._replace(
        uv=settings[UV],
        debug=settings[DEBUG],
        allow_shell_nodes=settings[ALLOW_SHELL_NODES],
        grace=settings[GRACE_DURATION],
        exit_when_nodes_finish=settings[EXIT_WHEN_NODES_FINISH],
        start_timeout=settings[START_TIMEOUT],
        settings=changed(tuple(runner_texts(settings, options.working_directory)), settings.passed),
    )
    try:
        policies_of(given)
    except DoraSystemdError as error:
        raise _of_files(settings, error) from error
    return given


def _of_files(settings: Settings, error: DoraSystemdError) -> DoraSystemdError:
    """The error about restarts; it names the settings files if nothing else has set them."""
    keys = {*(one.name for one in POLICY_SETTINGS), NODES} & settings.sources.keys()
    sources = {one for key in keys for one in settings.sources[key].split(", ")} - {DEFAULT_SOURCE}
    if not all(one.startswith("/") for one in sources):
        return error
    return bad_input(f"{error.message} ({', '.join(map(shown, sorted(sources)))})", error.hint)


def runner_texts(settings: Settings, directory: str | None = None) -> Iterator[SettingText]:
    """The settings that the runner receives as text, as far as they are given.

    directory: the working directory, None as long as nothing starts. Raises DoraSystemdError.
    """
    table = {setting.name: setting for setting in settings.table}
    of_all = {one.name: settings[one] for one in settings.table if _is_passed(one, settings)}
    for node, values in {"": of_all, **settings.nodes}.items():
        for key, value in values.items():
            setting = table[key]
            if setting.at_start and directory is not None:
                value = setting.at_start(value, directory)
            yield from (SettingText(node, key, text) for text in setting.of_node().format(value))


def _is_passed(setting: Setting[Any], settings: Settings) -> bool:
    """Whether the runner gets the value for the dataflow, because the unit does not have it."""
    is_in_unit = setting.property or setting.node_kind
    return setting.name in MODULES and not is_in_unit and settings.is_given(setting)


def idle_warnings(settings: Settings) -> Iterator[str]:
    """A warning for each setting that has no effect without another one."""
    for flag, _, needed in _idle(settings):
        yield f"{flag} has no effect without {needed.flags[0]}"


def require_effect(settings: Settings, flags: Container[str]) -> None:
    """Raise DoraSystemdError (USAGE) for a flag that has no effect without another setting.

    flags: the names of those that count. A settings file may have the same key: it may be for more
    than one dataflow.
    """
    nodes = settings.flagged_nodes if NODES in flags else {}
    flagged = {_flag_of(node, key) for node, own in nodes.items() for key in own}
    for flag, setting, needed in _idle(settings):
        is_flag = setting.name in flags and flag in settings.source(setting).split(", ")
        if is_flag or flag in flagged:
            hint = f"add {needed.flags[0]}, or write {setting.name} in a settings file"
            raise usage_error(f"cannot use {flag} without {needed.flags[0]}", hint)


def _flag_of(node: str, key: str) -> str:
    return f"--node {node}:{key}"


def _idle(settings: Settings) -> Iterator[tuple[str, Setting[Any], Setting[Any]]]:
    """The flags of settings that are given and have no effect without another one, and both."""
    policies = {settings[RESTART_POLICY], *settings.by_node(RESTART_POLICY).values()}
    owes = settings.by_node(OWES).values()
    policies |= {"on-failure" for one in owes for owed in one if owed.then == RESTART}
    idle: list[tuple[Setting[Any], Setting[Any]]]
    idle = [(one, RESTART_POLICY) for one in POLICY_SETTINGS[1:] if policies == {"no"}]
    idle += [(one, HOT_RELOAD) for one in (WATCH, IGNORE) if not settings[HOT_RELOAD]]
    yield from ((one.flags[0], one, needed) for one, needed in idle if settings.is_given(one))
    watched = () if settings[HOT_RELOAD] else settings.by_node(WATCH)
    yield from ((_flag_of(node, WATCH.name), WATCH, HOT_RELOAD) for node in watched)
