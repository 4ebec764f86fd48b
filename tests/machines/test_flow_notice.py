"""on_failure of a dataflow over several machines: the head says which machine is lost, once."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.names import notice_unit
from tests.machines.flows import GRACE, NAME, PLACE, TWO, Flow, flow_on
from tests.machines.journals import AGAIN, LOST
from tests.machines.wires import cable
from tests.system.cells import Project, run, wait_for

TELL = """#!/bin/sh
env | grep ^DORA_NOTICE_ >"$OUT/$$.new"
mv "$OUT/$$.new" "$OUT/$$.notice"
"""
OUT = Path("/srv/notices")


@pytest.fixture
def told() -> Iterator[Flow]:
    """A dataflow that sends notices, on machines that have their units."""
    run("doractl", "setup")
    # A notice counts the failures before it, and earlier tests had dataflows of this name.
    run("journalctl", "--rotate", "--vacuum-size=1")
    OUT.mkdir()
    OUT.chmod(0o777)
    with flow_on(Flow(TWO), [*LOST, *AGAIN]) as flow:
        tell = Project(Path(PLACE), is_new=False).write("tell.sh", TELL)
        tell.chmod(0o755)
        policy = ("--restart-policy=on-failure", f"--grace-duration={GRACE}s")
        flow.start(*policy, f"--on-failure={tell}", f"--writable={OUT}", f"--env=OUT={OUT}")
        flow.wait_exchanging()
        yield flow
    run("doractl", "setup", "--remove", check=False)
    run("rm", "-r", str(OUT))


def notices() -> list[str]:
    files = sorted(OUT.glob("*.notice"), key=lambda one: one.stat().st_mtime_ns)
    return [one.read_text() for one in files]


def test_a_lost_machine_is_reported(told: Flow) -> None:
    life = told.life()
    with cable("b", "off"):
        (text,) = wait_for("the notice", notices)
        assert "DORA_NOTICE_EVENT=machine-lost\n" in text
        assert f"DORA_NOTICE_DATAFLOW={NAME}\n" in text
        assert "gpu" in text.partition("DORA_NOTICE_SUMMARY=")[2].partition("\n")[0]
    told.wait_again(life)
    ended = ("systemctl", "is-active", notice_unit(NAME))
    wait_for("its end", lambda: "inactive" in run(*ended, check=False).stdout)
    assert len(notices()) == 1, "its return is no failure"
