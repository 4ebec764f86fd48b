"""One dataflow over several machines: from its start to its end."""

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import NAME, PLACE, THREE, TWO, Flow, flow_on
from tests.machines.journals import announced
from tests.machines.wires import there, wait_up
from tests.system.cells import run


@pytest.fixture(params=[TWO, THREE], ids=["two", "three"])
def flow(request: pytest.FixtureRequest) -> Iterator[Flow]:
    """A dataflow whose files are everywhere."""
    with flow_on(Flow(request.param), announced(request)) as flow:
        yield flow


def listeners(machine: str) -> set[str]:
    """The addresses with a listener that others can reach."""
    lines = there(machine, "ss", "-Hltn").stdout.splitlines()
    found = {line.split()[3] for line in lines}
    return {one for one in found if not one.startswith(("127.0.0.1:", "[::1]:"))}


def test_a_life(flow: Flow) -> None:
    started = flow.start()
    assert started.returncode == 0, started.stderr
    flow.wait_exchanging()
    nodes = flow.table()
    assert {node: one.get("machine") for node, one in nodes.items()} == {
        "source": "head",
        "doubler": "gpu",
        "sink": "arm" if "arm" in flow.members else "head",
    }
    assert {one["state"] for one in nodes.values()} == {"running"}
    token = json.loads((flow.cell.paths.control).read_text())["token"]
    for machine in flow.machines:
        assert listeners(machine) == {"0.0.0.0:22", "[::]:22"}
        assert token not in there(machine, "cat /proc/[0-9]*/cmdline | tr '\\0' '\\n'").stdout
    on_b = there("b", "journalctl", "-q", "-o", "cat", "-t", f"{NAME}/doubler").stdout
    assert "ready" in on_b
    stopped = flow.cell.doractl("stop", NAME)
    assert stopped.returncode == 0
    for machine in flow.machines:
        assert not there(machine, "systemctl", "-q", "list-units", "doralink-*").stdout.strip()
    assert not flow.left()


@pytest.mark.parametrize("flow", [THREE], indirect=True)
def test_again_and_a_restart(flow: Flow) -> None:
    flow.start()
    life = flow.life()
    done = flow.cell.doractl("restart", NAME)
    assert done.returncode == 0, done.stderr
    flow.wait_again(life)
    # What could not start again keeps running.
    there("b", f"cp {PLACE}/dataflow.yml /tmp/good; echo '# changed' >> {PLACE}/dataflow.yml")
    life = flow.life()
    refused = flow.cell.doractl("restart", NAME, check=False)
    assert "machine gpu: " in refused.stderr
    assert "is not the same file as on the head" in refused.stderr
    assert (refused.returncode, flow.life()) == (ExitCode.BAD_INPUT, life)
    there("b", f"cp /tmp/good {PLACE}/dataflow.yml")
    flow.cell.doractl("stop", NAME)
    flow.start()
    flow.wait_exchanging()


@pytest.mark.warns("flow failed: ", "Failed with result", "Failed to start")
@pytest.mark.parametrize("flow", [TWO], indirect=True)
class TestRefusals:
    """One line, and nothing is left anywhere."""

    def test_another_file_there(self, flow: Flow) -> None:
        there("b", f"echo '# changed' >> {PLACE}/dataflow.yml")
        flow.refused("gpu", "not the same file", code=ExitCode.BAD_INPUT)

    def test_the_name_is_taken_there(self, flow: Flow) -> None:
        command = f"systemd-run -q --unit dora-{NAME} sleep 1000"
        assert there("b", command).returncode == 0
        try:
            flow.refused("gpu", "already exists", code=ExitCode.BAD_INPUT)
        finally:
            there("b", "systemctl", "stop", f"dora-{NAME}")

    def test_no_doractl_there(self, flow: Flow) -> None:
        there("b", "mv /opt/lab/bin/doractl /opt/lab/bin/doractl.away")
        try:
            flow.refused("cannot find doractl on b", code=ExitCode.NO_HOST)
        finally:
            there("b", "mv /opt/lab/bin/doractl.away /opt/lab/bin/doractl")

    def test_a_strange_host_key(self, flow: Flow) -> None:
        known = "/root/.ssh/known_hosts"

        run("sh", "-c", f"cp {known} {known}.kept; sed -i '/^b /d' {known}")
        try:
            flow.refused("gpu", "Host key verification failed", code=ExitCode.NO_HOST)
        finally:
            run("mv", f"{known}.kept", known)

    def test_no_such_host(self, flow: Flow) -> None:
        del flow
        words = ("machine gpu: cannot reach nowhere", "Could not resolve hostname")
        Flow({"gpu": "nowhere"}).refused(*words, code=ExitCode.NO_HOST)

    def test_an_older_doractl_there(self, flow: Flow) -> None:
        old = "#!/bin/sh\necho \"doractl: unknown command 'member'\" >&2; exit 2\n"
        there("b", "mv /opt/lab/bin/doractl /opt/lab/bin/doractl.away")
        there("b", f"printf '%s' {shlex.quote(old)} > /opt/lab/bin/doractl")
        there("b", "chmod +x /opt/lab/bin/doractl")
        try:
            words = ("doractl on b has failed: unknown command 'member'", "the same version")
            flow.refused(*words, code=ExitCode.NO_HOST)
        finally:
            there("b", "mv /opt/lab/bin/doractl.away /opt/lab/bin/doractl")

    def test_a_login_shell_that_runs_nothing(self, flow: Flow) -> None:
        del flow
        assert there("b", "/usr/sbin/usermod -s /usr/sbin/nologin alice").returncode == 0
        try:
            words = ("cannot run doractl on alice@b", "not available")
            Flow({"gpu": "alice@b"}).refused(*words, code=ExitCode.NO_HOST)
        finally:
            there("b", "/usr/sbin/usermod -s /bin/bash alice")

    def test_an_sshd_that_forwards_nothing(self, flow: Flow) -> None:
        here = "/etc/ssh/sshd_config.d/00-closed.conf"
        there("b", f"mkdir -p /etc/ssh/sshd_config.d; echo AllowTcpForwarding no > {here}")
        there("b", "systemctl restart ssh")
        wait_up("b")
        try:
            words = ("cannot forward a port to b", "AllowTcpForwarding yes")
            flow.refused(*words, code=ExitCode.NO_HOST)
        finally:
            there("b", f"rm {here}; systemctl restart ssh")
            wait_up("b")

    def test_a_machine_that_may_just_boot(self, flow: Flow) -> None:
        """It is waited for, and a pipe hears that."""
        away = Flow({"gpu": "b:2222"})
        done = away.start("--start-timeout=5s", check=False)
        assert done.returncode == ExitCode.NO_HOST, done.stderr
        first, *_ = done.stderr.splitlines()
        assert first.startswith("waiting for machine gpu (connect to host b port 2222: ")
        assert "cannot reach machine gpu (connect to host b port 2222: " in done.stderr
        assert not flow.left()


@pytest.mark.parametrize("flow", [TWO], indirect=True)
def test_the_head_alone_is_enabled(flow: Flow) -> None:
    """Its unit file and those of its links start the whole; the member has none."""
    link = Path(f"/etc/systemd/system/doralink-{NAME}:gpu.service")
    flow.start()
    try:
        enabled = flow.cell.doractl("enable", NAME)
        assert enabled.returncode == 0, enabled.stderr
        assert link.exists()
        flow.cell.doractl("stop", NAME)
        assert not flow.left()
        flow.cell.systemctl("start")  # as a boot does
        flow.wait_exchanging()
        assert flow.cell.show("FragmentPath") == str(link.with_name(flow.cell.unit))
        fragment = run("systemctl", "show", "-P", "FragmentPath", link.name).stdout.strip()
        assert fragment == str(link)
        again = flow.start(check=False)
        assert again.returncode == ExitCode.NAME_IN_USE
        flow.cell.doractl("stop", NAME)
        same = flow.start()
        assert same.returncode == 0, same.stderr
    finally:
        flow.cell.doractl("disable", NAME)
    assert not link.exists()
    flow.wait_exchanging()
    assert flow.cell.doractl("stop", NAME).returncode == 0
    units = run("systemctl", "list-units", "--all", "--plain", "--no-legend", "dora*flow*").stdout
    assert not units.strip()
