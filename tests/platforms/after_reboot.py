"""After the reboot they are there again, with their UUIDs, and nobody has logged in."""

import json

import pytest

from tests.platforms.enabled import NOTES, USERS, doractl, row
from tests.system.cells import run, wait_for


@pytest.mark.parametrize("user", USERS)
def test_it_is_there_again(user: str) -> None:
    assert len(run("journalctl", "--list-boots", "--no-pager").stdout.splitlines()) >= 2
    wait_for("it runs", lambda: row(user)["status"] == "Running")
    shown = row(user)
    assert shown["uuid"] == json.loads(NOTES.read_text())[user]
    assert (shown["nodes_alive"], shown["enabled"], shown["restarts"]) == (3, True, 0)
    logs = "logs robot --node sink -o cat --no-pager"
    wait_for("the sink prints", lambda: "got" in doractl(user, f"{logs} -n 5"))
    assert "3/3 nodes running" in doractl(user, "why robot")
    assert "Dataflow restarted: " in doractl(user, "restart robot")
    assert "Dataflow stopped: " in doractl(user, "stop robot")
