"""Reads the settings of a dataflow that is to be started, and checks whose files to trust."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dora_systemd.adapters.host.files import decoded, find_line, parse_yaml
from dora_systemd.decisions.cell.rights import BY_KEY
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings
from dora_systemd.decisions.settings.rights import NODE_RIGHTS
from dora_systemd.decisions.settings.table import ENV_FILE, SETTINGS
from dora_systemd.errors import DoraSystemdError, ExitCode, WrongKey
from dora_systemd.names import settings_path
from dora_systemd.scope import Scope, config_home
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import Place, exists, hint_of_changeable
from dora_systemd.values import shown

SYSTEM_FILE = Path("/etc/dora-systemd/config.yml")
USER_FILE = Path("dora-systemd/config.yml")


@dataclass(frozen=True)
class SettingsFile:
    """A settings file that was read: its content, and its place."""

    path: Path
    place: Place
    data: bytes
    document: object

    @property
    def is_roots(self) -> bool:
        """Whether only root can have written and placed the file."""
        return not self.place.changeable

    def words(self) -> Mapping[object, object]:
        """Its keys."""
        return self.document if isinstance(self.document, dict) else {}


def settings_files(dataflow: Path, environment: Mapping[str, str]) -> list[Path]:
    """The settings files that may exist, highest precedence first."""
    return [Path(settings_path(str(dataflow))), *config_files(environment)]


def config_files(environment: Mapping[str, str]) -> list[Path]:
    """The settings files for all dataflows that may exist, highest precedence first."""
    config = config_home(environment)
    return [*([Path(config) / USER_FILE] if config else []), SYSTEM_FILE]


def read_settings(
    scope: Scope,
    dataflow: Path,
    flags: Mapping[str, object],
    environment: Mapping[str, str],
    origin: Place | None = None,
) -> Settings:
    """The settings from flags, variables and files. Raises DoraSystemdError.

    dataflow: its absolute path. In system scope, another user's file may only contain what that
    user may decide, and the environment files that it names are `lent`: read as that user.
    origin: of a release, the place of the original dataflow file, which counts for the settings
    file that was copied with it.
    """
    beside, *elsewhere = settings_files(dataflow, environment)
    found = [read_settings_file(beside, origin)] if exists(beside) else []
    found += [read_settings_file(path) for path in elsewhere if exists(path)]
    others = [] if scope.is_user else [one for one in found if not one.is_roots]
    for one in others:
        require_modest(one)
    settings = _resolved(found, flags, environment)
    if not any(ENV_FILE.name in one.words() for one in others):
        return settings
    roots = _resolved([one for one in found if one not in others], flags, environment)
    named, by_root = settings[ENV_FILE], roots[ENV_FILE]
    return replace(settings, lent=frozenset(one for one in named if one not in by_root))


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


def config_file(scope: Scope, environment: Mapping[str, str]) -> Path:
    """The settings file for all dataflows of the scope; it need not exist."""
    return config_files(environment)[0] if scope.is_user else SYSTEM_FILE


def key_place(scope: Scope, environment: Mapping[str, str]) -> Path:
    """The directory with the keys of machines, one file each; it need not exist."""
    return config_file(scope, environment).parent / "ssh"


def read_config(scope: Scope, environment: Mapping[str, str]) -> Settings:
    """The settings for all dataflows. Raises DoraSystemdError."""
    found = [read_settings_file(one) for one in config_files(environment) if exists(one)]
    for one in found:
        if not scope.is_user and not one.is_roots:
            _check_trust(one)
    return _resolved(found)


def check_config(scope: Scope, path: Path) -> None:
    """Raise DoraSystemdError for a settings file with which no dataflow would start."""
    read = read_settings_file(path)
    if not scope.is_user and not read.is_roots:
        require_modest(read)
    _resolved([read])


def require_modest(read: SettingsFile) -> None:
    """Raise DoraSystemdError for what a settings file may not say that is not the caller's."""
    _check_trust(read)
    _check_values(read)


def read_settings_file(path: Path, origin: Place | None = None) -> SettingsFile:
    """One settings file. origin: of a copy. Raises DoraSystemdError (BAD_INPUT)."""
    text = read_file(path)
    document = parse_yaml(decoded(text.data, path), path, allow_empty=True)
    return SettingsFile(path, origin or text.place, text.data, document)


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
            flag = (NODE_RIGHTS if setting.name in BY_KEY else setting).flags[0]
            for node, value in settings.by_node(setting).items():
                if raises(value):
                    yield f"nodes.{node}.{setting.name}", flag


def _check_trust(read: SettingsFile) -> None:
    """Refuse keys by which another user's file could make root read, run or grant something."""
    only = {setting.name: setting for setting in SETTINGS if setting.root_only}
    dangerous = [only[key] for key in read.words() if key in only]
    if dangerous:
        raise _untrusted(read, dangerous[0].name, dangerous[0].flags[0])


def _untrusted(read: SettingsFile, key: str, flag: str) -> DoraSystemdError:
    instead = f"give {flag} on the command line, or set it in {SYSTEM_FILE}"
    return DoraSystemdError(
        f"cannot use {shown(str(read.path))}: {key} is set there, and {read.place.changeable}",
        hint_of_changeable(read.path, SYSTEM_FILE, instead),
        ExitCode.NO_PERMISSION,
    )
