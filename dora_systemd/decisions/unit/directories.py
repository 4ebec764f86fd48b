"""The directories of unit files. `list` needs this module: it imports only what loads quickly."""

from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError

_HINT = "systemctl show --property UnitPath; is SYSTEMD_UNIT_PATH set for systemd?"


class UnitDirectories(NamedTuple):
    """The directory of the admin's (or user's) unit files, and the one that a reboot empties."""

    persistent: str
    runtime: str


def unit_directories(
    search_path: Sequence[str], is_user: bool, runtime_root: str
) -> UnitDirectories:
    """The two directories of a manager, from its property UnitPath.

    runtime_root: a reboot empties everything below it. Raises DoraSystemdError.
    """
    ending = "/systemd/user" if is_user else "/systemd/system"
    fleeting = ("/run/", f"{runtime_root}/")
    places = (one for one in search_path if one.endswith(ending))
    lasting = next((one for one in places if not one.startswith(fleeting)), None)
    if lasting is None:
        raise DoraSystemdError(f"cannot find a directory {ending} for unit files", _HINT)
    return UnitDirectories(lasting, runtime_root + ending)
