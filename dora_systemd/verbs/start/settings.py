"""Resolves the settings of a start, and checks by owner what a settings file may contain."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dora_systemd.adapters.host.files import decoded, find_line
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings
from dora_systemd.decisions.settings.stops import STOP_LIMIT
from dora_systemd.decisions.settings.table import (
    ENV_FILE,
    GRACE_DURATION,
    NODES,
    SETTINGS,
    USER,
)
from dora_systemd.errors import DoraSystemdError, ExitCode, WrongKey, bad_input
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import hint_of_changeable
from dora_systemd.values import INFINITY, as_mapping, format_duration, shown
from dora_systemd.verbs.start.read import (
    SYSTEM_FILE,
    Files,
    SettingsFile,
    read_general,
    read_settings_file,
)
from dora_systemd.verbs.start.request import StartRequest


def settings_of(scope: Scope, files: Files, request: StartRequest) -> Settings:
    """The settings from the flags and variables of a request, and from files.

    In system scope, another user's file may only contain what that user may decide, and the
    environment files that it names are `lent`: read as that user. Raises DoraSystemdError.
    """
    flags, environment = request.flags, request.environment
    found = [*([files.beside] if files.beside else []), *files.general]
    if scope.is_user:
        found = [_without_user(one) if one.path == SYSTEM_FILE else one for one in found]
    others = [] if scope.is_user else [one for one in found if not one.is_roots]
    for one in others:
        require_modest(one)
    settings = _resolved(found, flags, environment)
    for one in others:
        _check_grace(settings, one)
    if not any(ENV_FILE.name in as_mapping(one.document) for one in others):
        return settings
    roots = _resolved([one for one in found if one not in others], flags, environment)
    named, by_root = settings[ENV_FILE], roots[ENV_FILE]
    return replace(settings, lent=frozenset(one for one in named if one not in by_root))


def _without_user(read: SettingsFile) -> SettingsFile:
    """The system's settings file for user scope: its `user` is for dataflows of the system."""
    document = as_mapping(read.document)
    if USER.name not in document:
        return read
    return read._replace(document={key: one for key, one in document.items() if key != USER.name})


def _resolved(
    files: Sequence[SettingsFile],
    flags: Mapping[str, object] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Settings:
    """The settings from flags, variables and `files`; an error names the line of a wrong key."""
    documents = [(str(one.path), one.document) for one in files]
    try:
        return resolve_settings(flags or {}, environment or {}, documents, SETTINGS)
    except WrongKey as error:
        (text,) = (decoded(one.data, one.path) for one in files if str(one.path) == error.source)
        raise error.at_line(find_line(text, error.place)) from error


def read_config(scope: Scope, environment: Mapping[str, str]) -> Settings:
    """The settings for all dataflows. Raises DoraSystemdError."""
    found = read_general(environment)
    for one in found:
        if not scope.is_user and not one.is_roots:
            _check_trust(one)
    return _resolved(found)


def check_config(scope: Scope, path: Path) -> Settings:
    """Return the settings of a file. Raises DoraSystemdError if no dataflow would start with it."""
    read = read_settings_file(path)
    if not scope.is_user and not read.is_roots:
        require_modest(read)
    return _resolved([read])


def require_modest(read: SettingsFile) -> None:
    """Raise DoraSystemdError for settings that a file of another user must not contain."""
    _check_trust(read)
    _check_values(read)


def _check_values(read: SettingsFile) -> None:
    """Refuse values by which another user's file would get more than that user has."""
    own = _resolved([read])
    for key, flag in _raising(own):
        raise _untrusted(read, key, flag)


def _raising(settings: Settings) -> Iterator[tuple[str, str]]:
    """The keys of values that only root may give, and the flags with which it gives them."""
    for setting in SETTINGS:
        if (raises := setting.raises) is not None:
            if settings.is_given(setting) and raises(settings[setting]):
                yield setting.name, setting.flags[0]
            for node, value in settings.by_node(setting).items():
                if raises(value):
                    yield f"nodes.{node}.{setting.name}", NODES.flags[0]


def _check_trust(read: SettingsFile) -> None:
    """Refuse keys by which another user's file could make root read, run or grant something."""
    only = {setting.name: setting for setting in SETTINGS if setting.root_only}
    dangerous = [only[key] for key in as_mapping(read.document) if key in only]
    if dangerous:
        raise _untrusted(read, dangerous[0].name, dangerous[0].flags[0])


def _check_grace(settings: Settings, read: SettingsFile) -> None:
    """Refuse a grace duration of another user's file with which a stop exceeds stop_limit.

    A shutdown of the machine waits for the stop.
    """
    time, limit = kill_delay(settings[GRACE_DURATION]), settings[STOP_LIMIT]
    if settings.source(GRACE_DURATION) != str(read.path) or time <= limit:
        return
    grace = format_duration(settings[GRACE_DURATION])
    end = f"be killed after {format_duration(time)}" if time < INFINITY else "never be killed"
    message = (
        f"cannot use grace_duration {grace} in {shown(str(read.path))}: nodes would {end},"
        f" and stop_limit is {format_duration(limit)}"
    )
    hint = f"lower it, or root raises {STOP_LIMIT.flags[0]} or stop_limit in {SYSTEM_FILE}"
    raise bad_input(message, hint)


def _untrusted(read: SettingsFile, key: str, flag: str) -> DoraSystemdError:
    instead = f"give {flag} on the command line, or set it in {SYSTEM_FILE}"
    return DoraSystemdError(
        f"cannot use {shown(str(read.path))}: {key} is set there, and {read.place.changeable}",
        hint_of_changeable(read.path, SYSTEM_FILE, instead),
        ExitCode.NO_PERMISSION,
    )
