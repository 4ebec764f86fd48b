"""What differs between the systems that these tests run on."""

import os
from typing import NamedTuple


class Platform(NamedTuple):
    """A release of Debian. lacks: properties that doctor says its systemd has not."""

    systemd: str
    python: str
    lacks: tuple[str, ...] = ()
    has_watchfiles: bool = True
    keeps_commands: bool = True  # those of transient units, over a reload of systemd


PLATFORMS = {
    "bookworm": Platform(
        systemd="252",
        python="3.11",
        lacks=("DelegateSubgroup", "RestartSteps", "PrivatePIDs"),
        has_watchfiles=False,
        keeps_commands=False,
    ),
    "forky": Platform(systemd="262", python="3.14"),
}
HERE = PLATFORMS[os.environ["LAB"]]
