"""The files that `doractl setup` installs: those of the Debian package, for a pip install.

System-wide they go to the directories where systemd, man and the shells search for local files; for
a user, below the user's data directory, see file-hierarchy(7).
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from dora_systemd.decisions.properties.kinds import quote_word

SYSTEM_ROOT = "/"
PACKAGED_UNIT = "/usr/lib/systemd/system/dora.slice"
"""Exists if a package has installed all files."""

_MARKS = ("dora-systemd", "doractl(1)", "dora dataflows")
"""Every file of ours, of any version, contains one of these."""


class SetupFile(NamedTuple):
    """A file of the project, and its path below the root; with `link` a symbolic link."""

    source: tuple[str, str]  # its kind (a directory of the project) and its name
    place: str
    link: str = ""


_UNITS = (
    *("dora.slice", "dora.target", "dora-gateway.socket", "dora-gateway.service"),
    *("doranotice@.path", "doranotice@.service", "doranotice-hold@.service"),
)
SANDBOX = SetupFile(
    ("templates", "dora-gateway-sandbox.conf"), "dora-gateway.service.d/10-sandbox.conf"
)
"""Only works in the system manager; its path is below the directory of units."""
PACKAGED_PYTHON = "/usr/bin/python3"
_BASH = SetupFile(("completions", "doractl"), "share/bash-completion/completions/doractl")
_ZSH = SetupFile(("completions", "_doractl"), "share/zsh/site-functions/_doractl")
_FISH = SetupFile(("completions", "doractl.fish"), "share/fish/vendor_completions.d/doractl.fish")
_LOCAL = "usr/local"
# Below /usr/local, fish only searches directories of XDG_DATA_DIRS, which servers do not set.
_FISH_OF_ALL = _FISH._replace(place="etc/fish/completions/doractl.fish")
_SYSTEM_ONLY = (
    SetupFile(("templates", "dora-systemd.catalog"), "lib/systemd/catalog/dora-systemd.catalog"),
    SetupFile(("templates", "dora-systemd.sysusers"), "lib/sysusers.d/dora-systemd.conf"),
    SetupFile(("templates", "dora-systemd.tmpfiles"), "lib/tmpfiles.d/dora-systemd.conf"),
    SANDBOX._replace(place=f"lib/systemd/system/{SANDBOX.place}"),
    _ZSH,
)


def setup_files(is_user: bool, manuals: Iterable[str]) -> list[SetupFile]:
    """Return all files of one scope. manuals: names of the existing manual pages."""
    common = [_BASH]
    common += [SetupFile(("man", one), f"share/man/man{one[-1]}/{one}") for one in sorted(manuals)]
    if is_user:
        files = [*_units("share/systemd/user", "default.target"), *common, _FISH]
        # A user's files are all below one directory, which is itself called share.
        return [one._replace(place=one.place.removeprefix("share/")) for one in files]
    users = _units("lib/systemd/user", "default.target")
    system = _units("lib/systemd/system", "multi-user.target")
    local = [*system, *users, *_SYSTEM_ONLY, *common]
    return [*(one._replace(place=f"{_LOCAL}/{one.place}") for one in local), _FISH_OF_ALL]


def gateway_files(is_user: bool) -> list[SetupFile]:
    """The files that the gateway needs, with paths below a directory of units."""
    units = [SetupFile(("templates", unit), unit) for unit in _UNITS if "gateway" in unit]
    return units if is_user else [*units, SANDBOX]


def with_interpreter(text: str, python: str) -> str:
    """A unit file of ours for another Python interpreter than the package's."""
    return text.replace(f"ExecStart={PACKAGED_PYTHON} ", f"ExecStart={quote_word(python)} ")


def is_ours(text: str) -> bool:
    """Whether an existing file is one of ours, possibly of another version."""
    return any(mark in text for mark in _MARKS)


def _units(directory: str, target: str) -> Sequence[SetupFile]:
    units = [SetupFile(("templates", unit), f"{directory}/{unit}") for unit in _UNITS]
    boot = ("templates", "dora.target")
    return [*units, SetupFile(boot, f"{directory}/{target}.wants/dora.target", "../dora.target")]
