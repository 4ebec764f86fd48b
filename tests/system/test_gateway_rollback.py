"""A rollback of the status page in the gateway's sandbox, without a browser, and its end."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from websockets.sync.client import ClientConnection, connect

from dora_systemd.decisions.gateway.place import SERVICE_UNIT
from tests.lab.pace import bound
from tests.system.cells import Project, journalctl, run, wait_for
from tests.system.gateways import Front
from tests.system.releases import STORE, Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

FLAG = Path("/run/dora-test-stubborn")
STUBBORN = f"""
import pathlib, signal, time
if pathlib.Path('{FLAG}').exists():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1000)
"""
"""A node that is not ready, and does not end when it is told to."""
FAST = ("--soak", "0s")


@pytest.fixture
def flag() -> Iterator[Path]:
    """A file whose presence makes a node stubborn."""
    yield FLAG
    FLAG.unlink(missing_ok=True)


def two_versions(releases: Releases, project: Project, *options: str) -> tuple[str, str]:
    """Two releases, of which the second runs."""
    found = []
    for version in ("1", "2"):
        write_version(project, version, STUBBORN if version == "1" else "")
        releases.deploy(project.root, *FAST, *options)
        found.append(releases.current())
    return found[0], found[1]


def ask(page: ClientConnection, releases: Releases, release: str) -> None:
    """Press the button that rolls back."""
    cell = releases.cell
    row = json.loads(cell.doractl("list", cell.name, "-o", "json", check=False).stdout)
    message = {"type": "act", "action": "rollback", "dataflow": row["uuid"], "number": 7}
    page.send(json.dumps({**message, "release": release}))


def acted(page: ClientConnection) -> dict[str, str]:
    """The answer to that."""
    while True:
        found: dict[str, str] = json.loads(page.recv(timeout=bound(60)))
        if found["type"] == "acted":
            return found


def at_page(front: Front) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{front.port}/api/live", max_size=None)


def test_clean_keeps_the_releases(front: Front, releases: Releases, project: Project) -> None:
    """systemctl clean removes what belongs to a unit, and releases do not belong to the gateway."""
    first, second = two_versions(releases, project)
    front.up()
    with at_page(front) as page:
        page.recv()
    front.systemctl("stop", SERVICE_UNIT)
    for what in ("state", "all"):
        front.systemctl("clean", f"--what={what}", SERVICE_UNIT, check=False)
    assert front.show("StateDirectory") == ""
    assert set(releases.states()) == {first, second}
    # And what it may do, it can do in its sandbox.
    with at_page(front) as page:
        ask(page, releases, first)
        assert acted(page)["text"].endswith(f"runs release {first}")
        releases.check_only(first)
        # By itself it takes none that somebody has gone back from.
        write_version(project, "3")
        releases.deploy(project.root, *FAST)
        for text in (f"runs release {first}", "no release before the present one that ran well"):
            ask(page, releases, "")
            assert text in str(acted(page))
    assert list(releases.states().values()) == ["rolled-back", "rolled-back", "current"]
    releases.check_only(first)


def test_a_gateway_without_the_directory(front: Front) -> None:
    """It starts, and up makes the directory where tmpfiles.d has not."""
    place = STORE.parent
    run("rm", "-rf", str(place))
    front.up()
    assert (place.stat().st_mode & 0o777, place.stat().st_uid) == (0o755, 0)
    place.rmdir()
    assert front.get("/health").status == 200


@pytest.mark.warns("was rolled back: the gateway was stopped", "Signal(9)", "exited", "killed")
def test_a_stop_that_takes_longer_than_the_gateway_has(
    front: Front, releases: Releases, project: Project, flag: Path
) -> None:
    """A trial of a dataflow that was down: its end comes first, and the gateway waits for all."""
    cell = releases.cell
    seconds = round(bound(3))  # a slow gateway, too, has to say in time that it needs longer
    first, second = two_versions(releases, project, "--grace-duration", f"{3 * seconds}s")
    cell.doractl("stop", cell.name)
    flag.touch()
    front.up()
    drop_in = front.scope.runtime_root / f"systemd/system/{SERVICE_UNIT}.d/90-test.conf"
    drop_in.parent.mkdir(exist_ok=True)
    drop_in.write_text(f"[Service]\nTimeoutStopSec={seconds}s\n")
    front.systemctl("daemon-reload")
    with at_page(front) as page:
        ask(page, releases, first)
        wait_for("it is on trial", lambda: cell.show("StatusText").startswith("0/1 nodes"))
        begun = time.monotonic()
        front.systemctl("stop", SERVICE_UNIT)
        assert time.monotonic() - begun > seconds
    assert front.show("Result") == "success"
    assert not releases.trial.exists()
    assert (releases.current(), cell.show("ActiveState")) == (second, "inactive")
    name = f"DORA_DATAFLOW_NAME={cell.name}"
    told = journalctl("-o", "cat", name, "DORA_EVENT=release-rolled-back")
    assert "the gateway was stopped" in told
