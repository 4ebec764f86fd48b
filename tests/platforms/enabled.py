"""The dataflows that a reboot has to bring back: of root and alice by packages, of bob by uv."""

import json
import pwd
import shlex
from pathlib import Path
from typing import Any

from tests.platforms import test_packages, test_uv

NOTES = Path("/var/lib/enabled.json")
"""The UUIDs before the reboot, by user."""
USERS = (*test_packages.USERS, test_uv.USER)


def project_of(user: str) -> Path:
    return Path(pwd.getpwnam(user).pw_dir if user != "root" else "/srv") / "enabled"


def doractl(user: str, line: str) -> str:
    """What the doractl of `user` prints."""
    if user == test_uv.USER:
        return test_uv.as_user(f"doractl {line}").stdout
    return test_packages.doractl(user, *shlex.split(line)).stdout


def row(user: str) -> dict[str, Any]:
    (found,) = json.loads(doractl(user, "list -o json"))
    return dict(found)
