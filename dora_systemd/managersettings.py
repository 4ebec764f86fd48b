"""The settings of a dataflow that is to be started: which files there are, and whom to believe."""

from collections.abc import Mapping
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.files import read_yaml
from dora_systemd.names import settings_path
from dora_systemd.scope import Scope
from dora_systemd.settings import Settings, resolve_settings
from dora_systemd.settingtable import SETTINGS

SYSTEM_FILE = Path("/etc/dora-systemd/config.yml")
USER_FILE = Path("dora-systemd/config.yml")
_ROOT_ONLY = ("user", "property", "nice", "realtime", "credentials")
"""Keys with which whoever wrote a settings file could have commands run as root, read what only
root may read, or get more of the machine than root gave him."""


def settings_files(dataflow: Path, environment: Mapping[str, str]) -> list[Path]:
    """The settings files that may exist, the most important first, see design."""
    home = environment.get("HOME", "")
    config = environment.get("XDG_CONFIG_HOME", "") or (f"{home}/.config" if home else "")
    beside = Path(settings_path(str(dataflow)))
    user = [Path(config) / USER_FILE] if config.startswith("/") else []
    return [beside, *user, SYSTEM_FILE]


def read_settings(
    scope: Scope, dataflow: Path, flags: Mapping[str, object], environment: Mapping[str, str]
) -> Settings:
    """The settings from flags, variables and files. Raises DoraSystemdError."""
    there = [path for path in settings_files(dataflow, environment) if path.exists()]
    documents = [(str(path), read_yaml(path, allow_empty=True)) for path in there]
    for path, document in documents:
        if not scope.is_user:
            _check_trust(Path(path), document)
    return resolve_settings(flags, environment, documents, SETTINGS)


def _check_trust(path: Path, document: object) -> None:
    """Somebody else's file must not choose whom root runs his dataflow as."""
    dangerous = [key for key in _ROOT_ONLY if isinstance(document, dict) and key in document]
    if dangerous and path.stat().st_uid != 0:
        raise DoraSystemdError(
            f"cannot use {path}: {dangerous[0]} is set there, and the file is not root's",
            f"chown root {path}, or give --{_flag(dangerous[0])} on the command line",
            ExitCode.NO_PERMISSION,
        )


def _flag(key: str) -> str:
    return {"user": "uid", "credentials": "credential"}.get(key, key)
