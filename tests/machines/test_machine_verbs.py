"""doractl machine: a machine with a key of its own, and what that key can do."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.wires import cable, there
from tests.system.cells import run

KEY = "/etc/dora-systemd/ssh/gpu"
CONFIG = Path("/etc/dora-systemd/config.yml")
LINE = "grep -c dora-systemd:gpu /root/.ssh/authorized_keys"
BATCH = ("-oBatchMode=yes", "-oConnectTimeout=5")


@pytest.fixture
def gpu() -> Iterator[None]:
    """b is the machine gpu."""
    added = run("doractl", "machine", "add", "root@b", "--name", "gpu", check=False)
    assert added.returncode == 0, added.stderr
    assert "Machine added: gpu (root@b)" in added.stdout
    yield
    removed = run("doractl", "machine", "remove", "gpu", check=False)
    assert removed.returncode == 0, removed.stderr
    assert not Path(KEY).exists()
    assert there("b", LINE).stdout == "0\n"
    assert "gpu" not in CONFIG.read_text()


def by_key(*words: str) -> str:
    """What ssh says with that key alone."""
    done = run(
        "ssh", *BATCH, "-F/dev/null", "-oIdentitiesOnly=yes", f"-i{KEY}", *words, check=False
    )
    assert done.returncode != 0
    return done.stdout + done.stderr


def test_a_key_for_dataflows_only(gpu: None) -> None:
    del gpu
    assert there("b", LINE).stdout == "1\n"
    assert "can only run parts of dataflows" in by_key("root@b", "id")
    assert "can only run parts of dataflows" in by_key("root@b", "doractl", "stop", "--all")
    for wanted in ("10.77.0.2:61000", "127.0.0.1:5432"):
        listening = ("-oExitOnForwardFailure=yes", "-R", f"{wanted}:127.0.0.1:22")
        assert "forwarding failed" in by_key(*listening, "root@b", "id")
    assert "administratively prohibited" in by_key("-W127.0.0.1:22", "root@b")


def test_no_other_key_takes_its_place(gpu: None) -> None:
    """root of a may log in as root of b: a link whose key is not let in must not."""
    del gpu
    config = Path("/root/.ssh/config")
    before = config.read_text() if config.exists() else ""
    config.write_text(f"{before}Host b\n  IdentityFile /root/.ssh/id_ed25519\n")
    lines, kept = "/root/.ssh/authorized_keys", "/root/authorized_keys"
    there("b", f"cp {lines} {kept} && sed -i /dora-systemd:gpu/d {lines}")
    try:
        expected = ("flow: Dataflow flow failed: ", "dora-flow.service")
        with flow_on(Flow({"gpu": "b"}), expected) as flow:
            refused = flow.cell.start(Path(PLACE) / "dataflow.yml", check=False)
            checked = run("doractl", "machine", "check", "gpu", check=False)
    finally:
        there("b", "mv", kept, lines)
        config.write_text(before)
    assert refused.returncode != 0
    for said in (refused.stderr, checked.stdout):
        assert "the key of the machine is not let in" in said
        assert "doractl machine add" in said


def test_a_machine_that_is_away_is_not_removed(gpu: None) -> None:
    del gpu
    with cable("b", "off"):
        away = run("doractl", "machine", "remove", "gpu", check=False)
        assert away.returncode == ExitCode.NO_HOST
        assert "--force" in away.stderr
    assert Path(KEY).exists()


def test_a_dataflow_by_that_key(gpu: None) -> None:
    """No flag is needed, and no other key is used."""
    del gpu
    with flow_on(Flow({"gpu": "b"})) as flow:
        started = flow.cell.start(Path(PLACE) / "dataflow.yml")
        assert started.returncode == 0, started.stderr
        flow.wait_exchanging()
        link = run("systemctl", "show", "-P", "ExecStart", f"doralink-{NAME}:gpu.service").stdout
        assert f"--identity={KEY}" in link


def test_a_check(gpu: None) -> None:
    del gpu
    listed = run("doractl", "machine", "list").stdout.splitlines()
    assert listed[1].split() == ["gpu", "root@b", KEY]
    assert run("doractl", "machine", "check").stdout.startswith("ok       gpu: dora-systemd ")
    with cable("b", "off"):
        away = run("doractl", "machine", "check", "gpu", check=False)
        assert away.returncode == ExitCode.NO_HOST
        assert "cannot reach root@b" in away.stdout
    twice = run("doractl", "machine", "add", "root@b", "--name", "gpu", check=False)
    assert twice.returncode == ExitCode.NAME_IN_USE


def test_no_such_machine() -> None:
    for words in (("check", "arm"), ("remove", "arm")):
        assert run("doractl", "machine", *words, check=False).returncode == ExitCode.NOT_FOUND
    assert run("doractl", "machine", "add", "nowhere", check=False).returncode == ExitCode.NO_HOST
    assert not Path("/etc/dora-systemd/ssh/nowhere").exists()
