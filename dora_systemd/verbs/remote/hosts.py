"""The hosts of -H: from the command line, or from a hosts file."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.host.files import decoded
from dora_systemd.decisions.remote.hosts import ALL, Host, parse_host, parse_hosts_file
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.scope import config_home
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import exists, hint_of_changeable

SYSTEM_HOSTS = Path("/etc/dora-systemd/hosts")
USER_HOSTS = Path("dora-systemd/hosts")


def find_hosts(words: Sequence[str], environment: Mapping[str, str]) -> list[Host]:
    """The hosts that these words mean, each once. Raises DoraSystemdError."""
    found: dict[Host, None] = {}
    for word in words:
        found |= dict.fromkeys(listed_hosts(environment) if word == ALL else [parse_host(word)])
    return list(found)


def listed_hosts(environment: Mapping[str, str]) -> list[Host]:
    """The hosts of the user's hosts file, or of the system's if the user has none.

    Raises DoraSystemdError (BAD_INPUT) if there is no host.
    """
    places = host_files(environment)
    for path in filter(exists, places):
        if hosts := parse_hosts_file(_read(path), str(path)):
            return hosts
        raise _no_host(f"{path} names no host", path)
    raise _no_host(f"there is no {' and no '.join(map(str, places))}", places[0])


def host_files(environment: Mapping[str, str]) -> list[Path]:
    """The files that may list hosts; the first that exists counts."""
    config = config_home(environment)
    return [*([Path(config) / USER_HOSTS] if config else []), SYSTEM_HOSTS]


def _read(path: Path) -> str:
    """Read the hosts file. root logs in only to hosts that a file of root lists."""
    text = read_file(path)
    if os.geteuid() == 0 and (reason := text.place.changeable):
        instead = f"name the hosts on the command line, or list them in {SYSTEM_HOSTS}"
        hint = hint_of_changeable(path, SYSTEM_HOSTS, instead)
        raise DoraSystemdError(f"cannot use {path}: {reason}", hint, ExitCode.NO_PERMISSION)
    return decoded(text.data, path)


def _no_host(reason: str, path: Path) -> DoraSystemdError:
    hint = f"write one [user@]HOST[:PORT] in each line of {path}"
    return bad_input(f"cannot use all hosts: {reason}", hint)
