"""One dataflow over two machines: it starts, exchanges messages, shows itself and stops."""

from collections.abc import Iterator

import pytest

from tests.machines.flows import Flow, left_on, lifetime, listeners
from tests.machines.wires import there
from tests.system.cells import run, wait_for


@pytest.fixture(scope="module")
def flow() -> Iterator[Flow]:
    yield from lifetime(Flow("over"))


def test_nodes_run_where_they_are_placed(flow: Flow) -> None:
    assert set(flow.status.nodes) == {"source", "mid", "sink"}
    assert flow.status.nodes["mid"].machine == "gpu"
    assert flow.status.nodes["mid"].state == "running"
    assert flow.on_b("StatusText") == "1/1 nodes running"
    said = there("b", "journalctl", "-o", "cat", "-u", flow.unit, "DORA_NODE=mid").stdout
    assert "on b" in said
    group = there("b", "cat", f"/sys/fs/cgroup{flow.on_b('ControlGroup')}/node-mid/cgroup.procs")
    assert group.stdout.split(), "it has a group of its own there"


def test_both_have_one_uuid(flow: Flow) -> None:
    assert flow.status.uuid in flow.on_b("Description")


def test_nothing_listens_but_sshd(flow: Flow) -> None:
    assert flow.is_running()
    for name in ("a", "b"):
        assert listeners(name) == {"0.0.0.0:22", "[::]:22"}


def test_the_token_is_in_no_command_line(flow: Flow) -> None:
    token = (flow.paths.coordinator / ".dora-token").read_text().strip()
    assert len(token) > 20
    for found in (run("ps", "-eo", "args").stdout, there("b", "ps", "-eo", "args").stdout):
        assert "dora daemon" in found
        assert token not in found


def test_a_reload_is_refused(flow: Flow) -> None:
    done = flow.doractl("reload", flow.name, check=False)
    assert done.returncode == 1
    assert "it runs on several machines" in done.stderr


def test_a_restart_and_a_stop_take_both(flow: Flow) -> None:
    before = flow.life
    flow.doractl("restart", flow.name)
    flow.wait_running()
    assert flow.life != before
    flow.doractl("stop", flow.name)
    wait_for("nothing is left", lambda: not left_on("a") and not left_on("b"))
    ends = [event for event, _ in flow.events() if event in ("dataflow-stopped", "dataflow-failed")]
    assert set(ends) == {"dataflow-stopped"}
