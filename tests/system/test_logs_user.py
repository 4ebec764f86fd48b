"""In user scope journald's rate limit cannot be lifted: what it takes away is counted."""

import json
import pwd
import sys
from pathlib import Path

import pytest

from tests.system.cells import journalctl, run, wait_for

ROOT = Path(__file__).parents[2]
LINES = 60_000


# Asks another user's manager.
pytestmark = pytest.mark.lab


@pytest.fixture
def user() -> str:
    name = pwd.getpwuid(1000).pw_name
    run("loginctl", "enable-linger", name)
    wait_for("the user's manager", lambda: Path("/run/user/1000/bus").exists())
    return name


def test_loss_is_counted(user: str) -> None:
    unit = ["systemd-run", "--user", f"--machine={user}@.host", "--quiet", "--wait", "--pipe"]
    unit += ["--slice=dora.slice", f"--working-directory={ROOT}"]
    pump = [sys.executable, "-m", "tests.system.logpump", "--lines", str(LINES)]
    uuid = json.loads(run(*unit, *pump).stdout)["uuid"]
    match = f"DORA_DATAFLOW={uuid}"
    stored = journalctl("-o", "cat", match, "DORA_STREAM=stdout").count("\n")
    as_user = ["setpriv", "--reuid=1000", "--regid=1000", "--init-groups"]
    found = run(*as_user, "journalctl", "-q", "-o", "json", match, "DORA_EVENT=lines-lost").stdout
    lost = [int(json.loads(line)["DORA_COUNT"]) for line in found.splitlines()]
    assert sum(lost) == LINES - stored
