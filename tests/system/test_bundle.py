"""Bundles of a real dataflow: what is in them, and which secrets are not."""

import gzip
import json
import shutil
import stat
import subprocess
import tarfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.recorders import COUNTING, counted
from tests.system.test_record import has_more
from tests.system.test_record import start as start_recorded

# The units of notices are installed below /usr/local.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("units_for_all")]

STORE = Path("/var/lib/dora-systemd/bundles")
NODE = """
import os, sys, time
from dora import Node
node = Node()
print("logged by the node itself:", open("logged").read(), flush=True)
for event in node:
    if os.path.exists("fail"):
        sys.exit(3)
"""
CRASHES = ("crashed", "exit code 3", "ExitCode(3)", "restarted", "after failure", "Failed with")
SECRETS = {
    "an env value": "planted-env-0d9f",
    "an env_file": "planted-envfile-1c2b",
    "a credential": "planted-credential-2e41",
    "own argv": "planted-argv-3a77",
    "a password with a blank": "planted blank-4b10 word",
    "a token in a git URL": "planted-git-5c3d",
    "args": "planted-args-6f02",
    "the user part of a URL": "planted-userpart-7d65",
    "the text of the unit": "planted-unit-8e9c",
    "settings": "planted-settings-9ab4",
}
"""The eleventh secret, the token of the coordinator, is new in each life."""
LOGGED = "planted-logged-af3e"


@pytest.fixture
def bundles(cell: Cell) -> Iterator[Path]:
    """The directory of the bundles of the cell."""
    yield STORE / cell.name
    shutil.rmtree(STORE / cell.name, ignore_errors=True)


def plant(cell: Cell, project: Project) -> Path:
    """Write a project with a secret in each place where people put them."""
    own = SECRETS
    project.write("node.py", NODE)
    project.write("logged", LOGGED)
    project.write("variables", f"FROM_FILE={own['an env_file']}\n")
    project.write("credential", own["a credential"])
    run("git", "init", "-q", str(project.root))
    url = f"https://x:{own['a token in a git URL']}@git.example.org/robot.git"
    run("git", "-C", str(project.root), "remote", "add", "origin", url)
    project.write(
        "dataflow.systemd.yml",
        f"env: {{API: {own['an env value']}}}\n"
        f"env_file: {project.root}/variables\n"
        f"credentials: {{token: {project.root}/credential}}\n"
        f"on_failure: [/bin/true, {own['settings']}]\n"
        "restart_policy: no\n",
    )
    place = Path(f"/run/systemd/system/{cell.unit}.d/planted.conf")
    place.parent.mkdir(parents=True)
    place.write_text(f"[Service]\nEnvironment=PLANTED={own['the text of the unit']}\n")
    run("systemctl", "daemon-reload")
    password, camera = own["a password with a blank"], own["the user part of a URL"]
    return project.write(
        "dataflow.yml",
        "nodes:\n"
        "  - id: talker\n    path: node.py\n"
        f"    args: --key {own['args']}\n"
        "    inputs: {tick: dora/timer/millis/50}\n    outputs: [x]\n"
        f"    env: {{PASSWORD: '{password}', CAMERA: 'rtsp://me:{camera}@camera/1',\n"
        f"          SOURCE: '{url}'}}\n",
    )


def texts(path: Path) -> dict[str, bytes]:
    """The files of a bundle, with the journal unpacked."""
    with tarfile.open(path) as tar:
        found = {one.name: tar.extractfile(one) for one in tar}
        data = {name: file.read() for name, file in found.items() if file}
    if "journal.export.gz" in data:
        data["journal.export"] = gzip.decompress(data["journal.export.gz"])
    return data


def written(cell: Cell, *more: str) -> Path:
    sync_journal()
    return Path(cell.doractl("bundle", cell.name, *more).stdout.strip())


@pytest.mark.warns(*CRASHES, "exited with", "failed: ", "talker")
@pytest.mark.usefixtures("bundles")
def test_no_bundle_has_a_planted_secret(cell: Cell, project: Project) -> None:
    flow = plant(cell, project)
    cell.start(flow, "--env", f"TYPED={SECRETS['own argv']}")
    try:
        wait_for("it logs", lambda: cell.messages("talker"))
        token = json.loads(cell.paths.control.read_text())["token"]
        shown = cell.doractl("show", cell.name).stdout
        assert SECRETS["an env value"] in shown
        assert SECRETS["own argv"] in shown
        assert SECRETS["settings"] in shown
        running = written(cell)
        project.write("fail", "")
        wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
        failed = written(cell)
    finally:
        shutil.rmtree(f"/run/systemd/system/{cell.unit}.d")
        run("systemctl", "daemon-reload")
    for path in (running, failed):
        found = texts(path)
        planted = {**SECRETS, "our token": token}
        assert len(planted) == 11
        leaks = {
            f"{what}: {name}"
            for what, secret in planted.items()
            for name, data in found.items()
            if secret.encode() in data
        }
        assert not leaks
        assert LOGGED.encode() in found["journal.export"]
        assert b"a secret that a node has written to its log" in found["README.txt"]
        assert found["errors.txt"] == b""
        assert b"Environment=" in found["unit.txt"]
        assert b"API" in found["unit.txt"]
    without = texts(written(cell, "--no-journal", "-o", str(project.root / "out.tar")))
    assert LOGGED.encode() not in b"\n".join(without.values())
    assert not any(secret.encode() in b"\n".join(without.values()) for secret in SECRETS.values())


PRIVATE = ("nodes.json", "recording.mcap")
REFUSED = "only root and the user of the dataflow may read it"


def of_another_user(cell: Cell) -> dict[str, bytes]:
    """The files of a bundle that a user writes who may only read the journal."""
    path = Path(f"/tmp/{cell.name}.tar")
    user = ("setpriv", "--reuid=alice", "--regid=alice", "--groups=systemd-journal")
    said = run(*user, "doractl", "--system", "bundle", cell.name, "-o", str(path))
    try:
        assert said.stdout == f"{path}\n"
        assert all(f"not in the bundle: {one}: {REFUSED}" in said.stderr for one in PRIVATE)
        return texts(path)
    finally:
        path.unlink()


@pytest.mark.warns(*CRASHES)
def test_what_a_bundle_has(cell: Cell, project: Project, bundles: Path) -> None:
    cell.start(project.three_nodes())
    wait_for("it runs", lambda: cell.messages("sink"))
    path = written(cell)
    assert path.parent == bundles
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(bundles.stat().st_mode) == 0o700
    listed = run("tar", "-tf", str(path)).stdout.split()
    assert listed == [
        *("README.txt", "why.json", "journal.export.gz", "unit.txt", "cgroup.json"),
        *("nodes.json", "doctor.json", "errors.txt", "manifest.json"),
    ]
    found = texts(path)
    assert found["errors.txt"] == b""
    readme = found["README.txt"].decode()
    assert f"{cell.name}: Running" in readme
    assert {*json.loads(found["nodes.json"])["nodes"]} == {"source", "doubler", "sink"}
    assert json.loads(found["cgroup.json"])["nodes"]["sink"]["cpu_us"] > 0
    assert "ActiveState=active" in found["unit.txt"].decode()
    assert b"_CMDLINE" not in found["journal.export"]
    assert b"got [" in found["journal.export"]
    assert journalctl("DORA_EVENT=bundle-written", f"DORA_FILE={path}")
    # The journal's own tool reads the records back.
    remote = Path("/usr/lib/systemd/systemd-journal-remote")
    if remote.exists():
        (project.root / "journal.export").write_bytes(found["journal.export"])
        file = str(project.root / "read.journal")
        run(str(remote), "-o", file, str(project.root / "journal.export"))
        assert "got [" in run("journalctl", "--file", file, "-o", "cat").stdout
    lacking = of_another_user(cell)
    assert {*found} - {*lacking} == {"nodes.json"}
    assert lacking["errors.txt"].decode().splitlines() == [f"{one}: {REFUSED}" for one in PRIVATE]
    copied = str(shutil.copy(path, project.root / "copied.tar"))
    said = run("runuser", "-u", "alice", "--", "doractl", "why", "--bundle", copied, check=False)
    assert said.returncode == ExitCode.BAD_INPUT  # it is root's
    Path(copied).chmod(0o644)
    said = run("runuser", "-u", "alice", "--", "doractl", "why", "--bundle", copied)
    assert said.stdout == readme
    found_why = json.loads(cell.doractl("why", "--bundle", copied, "-o", "json").stdout)
    assert found_why["name"] == cell.name
    rows = json.loads(cell.doractl("bundles", cell.name, "-o", "json").stdout)
    assert [(row["bundle"], row["event"]) for row in rows] == [(path.name, "requested")]
    assert "No bundle" in cell.doractl("bundles", cell.name, "--remove", path.name).stdout + (
        cell.doractl("bundles", cell.name).stdout
    )
    assert not path.exists()


@pytest.mark.usefixtures("bundles")
def test_a_bundle_of_a_long_journal_is_quick(cell: Cell, project: Project) -> None:
    """As many records as a talkative dataflow writes in a day: the newest are kept."""
    line = "x" * 120
    project.write(
        "node.py",
        f"""
from dora import Node
node = Node()
for number in range(100_000):
    print(number, "{line}")
print("all written", flush=True)
for event in node:
    pass
""",
    )
    flow = "nodes: [{id: talker, path: node.py, inputs: {t: dora/timer/millis/100}}]\n"
    cell.start(project.write("dataflow.yml", flow))
    wait_for("all is read", lambda: "all written" in cell.messages("talker")[-1:], seconds=60)
    begun = time.monotonic()
    path = written(cell)
    seconds = time.monotonic() - begun
    begun = time.monotonic()
    journalctl("-o", "json", "-u", cell.unit)
    rival = time.monotonic() - begun  # twice as long, however busy the machine is
    found = texts(path)
    assert b"all written" in found["journal.export"]
    print(f"bundle of 100,000 records: {seconds:.1f} s, {path.stat().st_size} bytes")
    assert seconds < max(bound(3), rival)
    assert path.stat().st_size < 16 * 1024 * 1024


@pytest.mark.warns(*CRASHES, "talker", "exited with", "failed: ", "is not written")
def test_a_failure_that_nobody_has_seen(cell: Cell, project: Project, bundles: Path) -> None:
    """One bundle of many failures of one cause; the setting bounds them."""
    crash = "import sys\nfrom dora import Node\nfor e in Node():\n    sys.exit(3)\n"
    project.write("node.py", crash)
    flow = project.write(
        "dataflow.yml",
        "nodes: [{id: talker, path: node.py, inputs: {t: dora/timer/millis/100}}]\n",
    )
    project.write("dataflow.systemd.yml", "black_box: {keep: 2, size: 4M}\nrestart_policy: no\n")
    cell.start(flow, check=False)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    wait_for("a bundle is written", lambda: [*bundles.glob("*.tar")])
    (path,) = bundles.glob("*.tar")
    assert path.name.endswith("-failed.tar")
    assert path.stat().st_size <= 2 << 20
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    found = texts(path)
    about = json.loads(found["manifest.json"])
    assert (about["event"], about["node"], about["by"]) == ("failed", "talker", "doranotice")
    assert "node talker: exit code 3" in found["README.txt"].decode()
    assert found["errors.txt"] == b""
    wait_for("its event", lambda: journalctl("DORA_EVENT=bundle-written", f"DORA_FILE={path}"))
    cell.doractl("restart", cell.name, check=False)
    refused = ("DORA_EVENT=bundle-refused", f"DORA_DATAFLOW_NAME={cell.name}")
    wait_for("no second one", lambda: journalctl(*refused), seconds=60)
    assert [*bundles.glob("*.tar")] == [path]


def keeps_memory() -> bool:
    """Whether systemd keeps the memory of a recorder when its unit has failed for good."""
    return int(run("systemctl", "--version").stdout.split()[1]) >= 254


@pytest.mark.warns(*CRASHES, "talker", "exited with", "failed: ", "is not written")
@pytest.mark.parametrize("policy", ["no", "on-failure"])
def test_a_failure_has_its_recording(
    cell: Cell, project: Project, bundles: Path, policy: str
) -> None:
    """Also when the unit has failed for good; the memory is free when the dataflow is reset."""
    project.write("node.py", COUNTING)
    node = "{id: talker, path: node.py, inputs: {t: dora/timer/millis/20}, outputs: [count]}"
    flow = project.write("dataflow.yml", f"nodes: [{node}]\n")
    settings = f"black_box: yes\nrecord: yes\nrestart_policy: {policy}\n"
    project.write("dataflow.systemd.yml", settings)
    start_recorded(cell, flow, *(() if policy == "no" else ("--max-restarts", "1")))
    wait_for("it records", partial(has_more, 30))
    project.write("fail", "")
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed", seconds=60)
    wait_for("a bundle is written", lambda: [*bundles.glob("*.tar")])
    sync_journal()
    last = max(int(one) for one in cell.messages("talker"))
    found = texts(next(iter(bundles.glob("*.tar"))))
    assert found["errors.txt"] == b""
    numbers = counted(found["recording.mcap"])
    assert len(numbers) > 30
    assert max(numbers) <= last
    if policy == "no":
        assert numbers[-1] >= last - 1
    assert ("recording.mcap" in texts(written(cell))) is keeps_memory()
    (project.root / "fail").unlink()
    cell.doractl("restart", cell.name)
    assert cell.show("NRestarts") == "0"
    wait_for("it sends again", lambda: len(cell.messages("talker")) > last + 20)
    cell.doractl("stop", cell.name)
    wait_for("systemd unloads it", lambda: cell.show("LoadState") == "not-found")
    start_recorded(cell, flow)
    wait_for("it records again", partial(has_more, 30))
    project.write("fail", "")
    wait_for("it has failed again", lambda: cell.show("ActiveState") == "failed", seconds=60)
    assert (int(cell.show("NFileDescriptorStore")) > 0) is keeps_memory()
    cell.doractl("reset", cell.name)
    wait_for("systemd unloads it", lambda: cell.show("LoadState") == "not-found")


def test_a_full_disk(cell: Cell, project: Project) -> None:
    """It loses the bundle, with one line, and nothing is left of it."""
    cell.start(project.three_nodes())
    place = project.root / "full"
    place.mkdir()
    run("mount", "-t", "tmpfs", "-o", "size=900k", "tmpfs", str(place))
    try:
        arguments = ("bundle", cell.name, "-o", str(place / "x.tar"))
        said = cell.doractl(*arguments, check=False)
        assert said.returncode == ExitCode.FAILURE
        assert "cannot write a bundle" in said.stderr
        assert len(said.stderr.splitlines()) <= 2
        assert list(place.iterdir()) == []
    finally:
        subprocess.run(["umount", str(place)], check=True)
