"""deploy -H and rollback -H: a release for one host after the other, until one rolls it back."""

import json
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.releases import STORE, Releases, write_version
from tests.system.sshds import Servers, shell_of, three_hosts

pytestmark = pytest.mark.lab

HERS = Path("~alice/.local/state/dora-systemd/releases").expanduser()
FAST = ("--soak", "0s")
BAD = "raise SystemExit('the model is missing')\n"


@pytest.fixture
def servers() -> Iterator[Servers]:
    """See three_hosts()."""
    with three_hosts() as servers:
        yield servers


@pytest.fixture
def base(cell: Cell) -> Iterator[Releases]:
    """The releases of the dataflow on base."""
    found = Releases(cell)
    yield found
    found.end()


@pytest.fixture
def arm(cell: Cell, servers: Servers) -> Iterator[None]:
    """The dataflow of the same name on arm, which is down by the end."""
    del servers
    yield
    for verb in ("disable", "stop"):
        doractl("-H", "arm", verb, cell.name)
    shutil.rmtree(HERS, ignore_errors=True)  # root needs no write permission


def doractl(*words: str) -> subprocess.CompletedProcess[str]:
    return run("doractl", *words, check=False)


def deploy(project: Project, name: str, *words: str) -> subprocess.CompletedProcess[str]:
    return doractl("deploy", str(project.root), "--name", name, *words)


def rows(text: str) -> list[list[str]]:
    """The table without its header."""
    header, *lines = text.splitlines()
    assert header.split() == ["HOST", "RESULT", "RELEASE", "BEFORE"]
    return [" ".join(line.split("  ")).split() for line in lines]


def versions(cell: Cell, host: str) -> dict[str, str]:
    """The states of the releases on a host."""
    found = json.loads(doractl("-H", host, "releases", "-o", "json").stdout)
    return {one["release"]: one["state"] for one in found if one["name"] == cell.name}


@pytest.mark.usefixtures("arm")
def test_a_release_goes_from_host_to_host(base: Releases, project: Project) -> None:
    """What is there is what is here; the second release only brings what has changed."""
    name = base.cell.name
    write_version(project, "1")
    project.write("models/big.bin", "x" * 3_000_000)
    project.write("models/same.bin", "x" * 3_000_000)
    done = deploy(project, name, *FAST, "-H", "base,gone,arm")
    first, dead, second = rows(done.stdout)
    assert (first[:2], dead[:2], second[:2]) == (
        ["base", "deployed"],
        ["gone", "unreachable"],
        ["arm", "deployed"],
    )
    assert "cannot reach gone: connect to host" in done.stderr
    assert done.returncode == ExitCode.NO_HOST
    assert base.running() == base.current() == first[2]
    base.check_whole()
    tree = HERS / name / second[2] / "tree"
    assert (tree / "a.py").read_text() == (project.root / "a.py").read_text()
    (hers,) = json.loads(doractl("-H", "arm", "list", "-o", "json").stdout)
    assert (hers["name"], hers["status"], hers["release"]) == (name, "Running", second[2])
    # Code of bob does not become that of the user of root's dataflows.
    flow = project.root / "dataflow.yml"
    shutil.chown(flow, "bob")
    refused = deploy(project, name, *FAST, "-H", "base")
    assert (refused.returncode, "bob owns it" in refused.stderr) == (ExitCode.NO_PERMISSION, True)
    assert "--uid USER" in refused.stderr
    shutil.chown(flow, "root")
    # Nothing of the way is left.
    assert not list(STORE.glob(".sent*"))
    assert not list(HERS.glob(".sent*"))
    write_version(project, "2")
    (project.root / "latest").symlink_to("models/big.bin")
    compared = deploy(project, name, "--dry-run", "-H", "base,arm")
    assert compared.stdout == "==> base <==\n+ latest\n~ a.py\n\n==> arm <==\n+ latest\n~ a.py\n"
    done = deploy(project, name, *FAST, "-H", "base,arm", "--serial", "2", "-o", "json")
    found = {one["host"]: one for one in map(json.loads, done.stdout.splitlines())}
    assert found["base"]["details"]["former"] == first[2]
    assert found["arm"]["details"]["copied_bytes"] < 1000
    assert {one["result"] for one in found.values()} == {"done"}
    tree = HERS / name / found["arm"]["details"]["release"] / "tree"
    assert (tree / "latest").readlink() == Path("models/big.bin")
    # And back, on both.
    back = doractl("rollback", name, "-H", "base,arm")
    assert [row[:4] for row in rows(back.stdout)] == [
        ["base", "rolled", "back", first[2]],
        ["arm", "rolled", "back", second[2]],
    ]
    assert base.current() == first[2]


@pytest.mark.usefixtures("arm")
@pytest.mark.warns(
    "node exited with error", "exit code 1", "the model is missing", "Failed", "status=1"
)
def test_it_stops_at_the_first_host_that_rolls_back(base: Releases, project: Project) -> None:
    name = base.cell.name
    write_version(project, "good")
    assert deploy(project, name, *FAST, "-H", "base,arm").returncode == 0
    good = versions(base.cell, "base"), versions(base.cell, "arm")
    write_version(project, "bad", before=BAD)
    done = deploy(project, name, "-H", "base,arm", "--soak", "20s")
    assert [row[:3] for row in rows(done.stdout)] == [
        ["base", "rolled", "back"],
        ["arm", "not", "tried"],
    ]
    assert f"of {name} was rolled back: node a: exit code 1" in done.stderr
    assert done.returncode == ExitCode.ROLLED_BACK
    assert base.running() == base.current() == next(iter(good[0]))
    assert versions(base.cell, "arm") == good[1]
    told = deploy(project, name, "-H", "base,arm", "--soak", "20s", "-o", "json")
    first, second = map(json.loads, told.stdout.splitlines())
    assert (first["result"], first["error"]["exit_status"]) == ("rolled back", 11)
    assert (second["host"], second["result"], second["error"]) == ("arm", "not tried", None)


@pytest.mark.usefixtures("arm")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_it_ends_with_the_command(number: int, base: Releases, project: Project) -> None:
    """However that ends: the trial over there is undone."""
    name = base.cell.name
    write_version(project, "good")
    base.deploy(project.root, *FAST)
    good = base.current()
    write_version(project, "next")
    words = ("doractl", "-H", "base,arm", "deploy", str(project.root), "--name", name)
    with subprocess.Popen(
        [*words, "--soak", "1h"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        wait_for("it runs", lambda: "version next" in base.cell.messages("a"))
        child.send_signal(number)
        out, err = child.communicate(timeout=bound(60))
    if number == signal.SIGINT:
        assert child.returncode == ExitCode.INTERRUPTED
        assert [row[:3] for row in rows(out)] == [
            ["base", "rolled", "back"],
            ["arm", "not", "tried"],
        ]
        assert "the command was interrupted" in err
    wait_for("the trial has ended", lambda: not base.trial.exists())
    wait_for("it is back", lambda: base.running() == good)
    assert base.current() == good
    wait_for("nothing is left of the way", lambda: not list(STORE.glob(".sent*")))
    assert versions(base.cell, "arm") == {}


@pytest.mark.usefixtures("arm")
def test_what_a_host_refuses(
    base: Releases, project: Project, servers: Servers, tmp_path: Path
) -> None:
    """A line for each, with the name of the host; nothing has changed anywhere."""
    name = base.cell.name
    write_version(project, "1")
    # Another doractl.
    old = tmp_path / "bin/doractl"
    old.parent.mkdir()
    old.write_text("#!/bin/sh\necho 'doractl: unknown option --from-stdin' >&2\nexit 2\n")
    old.chmod(0o755)
    for path in (tmp_path, *tmp_path.parents[:1], old.parent):
        path.chmod(0o755)
    servers.serve("127.0.0.4", more=f"SetEnv PATH={old.parent}:/usr/bin:/bin")
    servers.name("other", "127.0.0.4")
    servers.serve("127.0.0.6", more="")
    servers.name("bare", "127.0.0.6")
    servers.name("forged", "127.0.0.2", key="other")
    done = deploy(project, name, "-H", "bare,forged,other,base")
    assert [(row[0], row[1]) for row in rows(done.stdout)] == [
        ("bare", "unreachable"),
        ("forged", "unreachable"),
        ("other", "failed"),
        ("base", "not"),
    ]
    assert "cannot find doractl on bare" in done.stderr
    assert "cannot reach forged: the host key has changed" in done.stderr
    assert "doractl: other: unknown option --from-stdin" in done.stderr
    assert len(done.stderr.splitlines()) == 5
    assert not base.path.exists()
    # A full disk, and a login shell that prints.
    noise = {".bashrc": "echo hello; echo warning >&2\n", ".profile": "echo hello\n"}
    project.write("model.bin", "x" * 1_000_000)
    STORE.mkdir(parents=True, exist_ok=True)
    run("mount", "-t", "tmpfs", "-o", "size=300k", "none", str(STORE))
    try:
        with shell_of("alice", "/bin/bash", noise):
            done = deploy(project, name, *FAST, "-H", "base", "-o", "json")
            (refused,) = map(json.loads, done.stdout.splitlines())
            assert "No space left on device" in refused["error"]["message"]
            assert done.returncode == ExitCode.FAILURE
            assert not list(STORE.glob(".*"))
            assert rows(deploy(project, name, *FAST, "-H", "arm").stdout)[0][:2] == [
                "arm",
                "deployed",
            ]
    finally:
        run("umount", "--lazy", str(STORE))
    assert not base.path.exists()
