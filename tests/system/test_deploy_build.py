"""doractl deploy of what has to be built first."""

import json
import shlex
import shutil
import subprocess
import sys
import sysconfig
import textwrap
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, journalctl, run, wait_for
from tests.system.homes import Home
from tests.system.releases import Releases, write_version

pytestmark = pytest.mark.lab

FAST = ("--soak", "0s")
FLOW = """
nodes:
- id: a
  path: made/a.py
  build: sh build.sh
  inputs: {t: dora/timer/millis/50}
"""
BUILD = """
set -e
echo "builds in $PWD"
mkdir made
cp a.py made/a.py
"""


def write_build(project: Project, build: str = BUILD, flow: str = FLOW) -> None:
    project.write("build.sh", build)
    project.write("dataflow.yml", flow)


def built_unit(cell: Cell) -> str:
    return f"doractl-build-{cell.name}.service"


def is_loaded(unit: str) -> bool:
    return bool(run("systemctl", "list-units", "--all", "--plain", "--no-legend", unit).stdout)


def printed(cell: Cell, field: str = "_SYSTEMD_UNIT") -> list[dict[str, str]]:
    """What builds have printed, from the journal."""
    found = journalctl(f"{field}={built_unit(cell)}", "-o", "json")
    return [json.loads(line) for line in found.splitlines()]


def test_a_release_has_what_its_build_makes(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "1")
    write_build(project)
    releases.deploy(project.root, *FAST)
    first = releases.current()
    tree = releases.path / first / "tree"
    assert cell.messages("a") == ["version 1"]
    (line,) = [one for one in printed(cell) if "builds in" in one["MESSAGE"]]
    assert line["MESSAGE"].endswith(f"builds in {tree}")
    assert (line["DORA_DATAFLOW_NAME"], line["DORA_RELEASE"]) == (cell.name, first)
    assert line["DORA_DATAFLOW"] == json.loads((tree.parent / "release.json").read_text())["uuid"]
    assert int(line["_UID"]) != 0
    releases.check_whole()
    assert "Nothing differs" in releases.deploy(project.root, "--dry-run")
    # The same runs on; forced, the next one builds again, and shares what has become the same.
    life = cell.show("InvocationID")
    assert f"unchanged: release {first} runs\n" == releases.deploy(project.root, *FAST)
    assert (cell.show("InvocationID"), releases.running()) == (life, first)
    releases.deploy(project.root, *FAST, "--force")
    inodes = {(releases.path / one / "tree/made/a.py").stat().st_ino for one in releases.states()}
    assert len(inodes) == 1
    cell.doractl("rollback", cell.name)
    assert releases.running() == first
    releases.check_whole()


BAD = {
    "fails": ("echo all is lost; exit 3", "a: all is lost", 5),
    "hangs": ("sleep 1000", "it did not end within 2s", 5),
    "leaves a link": ("mkdir made; ln -s /etc/hostname made/x", "cannot copy made/x: it links", 5),
    "leaves a FIFO": ("mkfifo x", "cannot copy x: it is a FIFO", 5),
    "changes the dataflow": ("echo >>dataflow.yml", "dataflow.yml: it changed", 5),
    "makes nothing": ("true", "made/a.py", 5),
}


@pytest.mark.warns("Failed", "exited", "timed out", "imeout", "Killing", "error")
def test_a_bad_build_changes_nothing(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "good")
    write_build(project)
    releases.deploy(project.root, *FAST)
    life, known = cell.show("InvocationID"), releases.states()
    for how, (build, words, status) in BAD.items():
        write_build(project, build)
        timeout = ("--build-timeout", "2s") if how == "hangs" else ()
        said = releases.deploy(project.root, "-q", *timeout, status=status)
        assert words in said, how
        assert len(said.splitlines()) <= 2, said
        assert not list(releases.path.glob(".*")), how
        wait_for("the unit is unloaded", lambda: not is_loaded(built_unit(cell)))
    assert (cell.show("InvocationID"), releases.states()) == (life, known)
    # Without the build there is no program; with it in the project there is.
    assert "made/a.py" in releases.deploy(project.root, "--no-build", status=5)
    project.write("made/a.py", (project.root / "a.py").read_text())
    releases.deploy(project.root, "--no-build", *FAST)
    project.write("dataflow.yml", "nodes: [{id: a, path: a.py, git: https://localhost/a.git}]")
    assert "comes from git" in releases.deploy(project.root, "--no-build", status=5)


LEAVES = """
setsid sh -c 'trap "" TERM HUP; touch {proof}; while true; do sleep 1; done' >/dev/null 2>&1 &
while ! [ -e {proof} ]; do sleep 0.05; done
"""


def test_no_process_of_a_build_is_left(releases: Releases, project: Project) -> None:
    cell, proof = releases.cell, "/tmp/build-proof"
    write_version(project, "1")
    write_build(project, BUILD + LEAVES.format(proof=proof))
    releases.deploy(project.root, *FAST)
    assert "build-proof" not in run("ps", "-eo", "args").stdout
    # Nor if doractl is killed in the middle of it, and the next deploy does not mind.
    write_build(project, BUILD + "echo on its way; sleep 1000\n")
    command = ("doractl", "--system", "deploy", str(project.root), "--name", cell.name)
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as child:
        wait_for("it builds", lambda: "on its way" in str(printed(cell)))
        child.kill()
    wait_for("it ends", lambda: "sleep 1000" not in run("ps", "-eo", "args").stdout)
    assert list(releases.path.glob(".build-*"))
    write_version(project, "2")
    write_build(project)
    releases.deploy(project.root, *FAST)
    assert not list(releases.path.glob(".*"))


def test_a_build_cannot_fill_the_disk(releases: Releases, project: Project) -> None:
    write_version(project, "good")
    write_build(project)
    releases.path.mkdir(parents=True)
    run("mount", "-t", "tmpfs", "-o", "size=40M", "none", str(releases.path))
    try:
        releases.deploy(project.root, *FAST)
        life, known = releases.cell.show("InvocationID"), releases.states()
        write_build(project, "head -c 39M /dev/zero >big; sleep 1000")
        said = releases.deploy(project.root, status=1)
        assert "it has left too little space on the disk" in said
        assert (releases.cell.show("InvocationID"), releases.states()) == (life, known)
        assert not list(releases.path.glob(".*"))
    finally:
        releases.cell.end()
        run("umount", "--lazy", str(releases.path))


PACKAGES = sysconfig.get_path("purelib")
IN_VENV = f"""
set -e
python -c 'import sys; assert sys.prefix == sys.argv[1], sys.prefix' "$PWD/.venv"
echo {PACKAGES} >$(echo .venv/lib/python3*/site-packages)/lab.pth
printf '#!%s/.venv/bin/python\\nimport sys; print("script", sys.prefix)\\n' "$PWD" >.venv/bin/script
chmod +x .venv/bin/script
"""
PYPROJECT = """
[project]
name = "robot"
version = "1"
requires-python = ">=3.11"
dependencies = ["robot-camera"]
[tool.uv.sources]
robot-camera = {path = "robot_camera-1-py3-none-any.whl"}
"""
USES_VENV = """
import subprocess, sys
from dora import Node
print("node", sys.prefix, flush=True)
print(subprocess.run(["script"], capture_output=True, text=True).stdout, end="", flush=True)
for event in Node():
    pass
"""
VENV_FLOW = FLOW.replace("made/a.py", "a.py")


def check_venv(releases: Releases) -> None:
    """The node ran by the virtual environment of its release, and its console script as well."""
    venv = releases.path / releases.current() / "tree/.venv"
    wait_for("it runs", lambda: len(releases.cell.messages("a")) == 2)
    assert releases.cell.messages("a") == [f"node {venv}", f"script {venv}"]
    assert releases.cell.show("ExecStart").count(f"--venv={venv}") == 1
    manifest = json.loads((venv.parents[1] / "release.json").read_text())
    found = [one for path, one in manifest["files"].items() if ".venv/bin/python" in path]
    assert any(one["link"].startswith("/") for one in found)


def test_a_virtual_environment_works_where_it_was_built(
    releases: Releases, project: Project
) -> None:
    make = f"{sys.executable} -m venv --without-pip .venv\n"
    project.write("a.py", USES_VENV)
    write_build(project, make + IN_VENV, VENV_FLOW)
    said = releases.deploy(project.root, *FAST)
    assert "share" not in said
    check_venv(releases)


CLONE = "nodes: [{id: a, path: robot-camera, inputs: {t: dora/timer/millis/50}}]"
ENTRY_POINTS = """
[console_scripts]
robot-camera = robot_camera:main
script = script_of_lab:main
"""


def about(name: str) -> dict[str, str]:
    """The files of a wheel that describe it."""
    named = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n"
    return {
        f"{name}-1.dist-info/METADATA": named,
        f"{name}-1.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\n",
    }


WHEEL = {
    "robot_camera.py": "def main():\n" + textwrap.indent(USES_VENV, "    "),
    "script_of_lab.py": "import sys\ndef main():\n    print('script', sys.prefix)\n",
    "lab.pth": PACKAGES,
    **about("robot_camera"),
    "robot_camera-1.dist-info/entry_points.txt": ENTRY_POINTS,
}


def write_clone(project: Project) -> None:
    """A project with a locked package, which has its node, as git clones it: without .venv."""
    project.write("pyproject.toml", PYPROJECT)
    project.write("dataflow.yml", CLONE)
    write_wheel(project, "robot_camera", WHEEL)
    write_wheel(project, "more", {"more.py": "", **about("more")})
    run("uv", "lock", "--offline", cwd=project.root)


def write_wheel(project: Project, name: str, files: Mapping[str, str]) -> None:
    """Write a package of these files into the project."""
    record = f"{name}-1.dist-info/RECORD"
    with zipfile.ZipFile(project.root / f"{name}-1-py3-none-any.whl", "w") as wheel:
        for path, text in files.items():
            wheel.writestr(path, text)
        wheel.writestr(record, "".join(f"{path},,\n" for path in (*files, record)))


@pytest.mark.warns("error")
def test_uv_sync_makes_the_virtual_environment_of_a_clone(
    releases: Releases, project: Project
) -> None:
    write_clone(project)
    # An environment that uv has made has no pip.
    wheel = "pip install --no-deps --no-index ./more-1-py3-none-any.whl"
    project.write("dataflow.yml", CLONE.replace("50}}", f"50}}, build: {wheel}}}"))
    releases.deploy(project.root, *FAST)
    check_venv(releases)
    venv = releases.path / releases.current() / "tree/.venv"
    (compiled,) = venv.glob("lib/python3*/site-packages/__pycache__/robot_camera.*.pyc")
    assert compiled.read_bytes()[4] == 0b11  # valid by the source's content
    assert list(venv.glob("lib/python3*/site-packages/more.py"))
    # Releases share what is compiled, for their own path is not in it.
    releases.deploy(project.root, *FAST, "--force")
    both = [*releases.path.glob("*/tree/.venv/lib/python3*/**/robot_camera.*.pyc")]
    assert (len(both), len({one.stat().st_ino for one in both})) == (2, 1)
    project.write("uv.lock", "[[")
    said = releases.deploy(project.root, "-q", status=5)
    assert "uv: Failed to parse `uv.lock`: TOML parse error" in said


@pytest.fixture
def origin() -> Iterator[Path]:
    """A repository of the user of the nodes, for git clones no other one's."""
    place = Path("/srv/test-of-builds")
    write_version(Project(place), "of git")
    for words in (("init", "-q", "-b", "main"), ("add", "."), ("commit", "-q", "-m", "all")):
        run("git", "-c", "user.name=a", "-c", "user.email=a@b", *words, cwd=place)
    run("chown", "-R", "dora", str(place))
    yield place
    shutil.rmtree(place)


def test_a_node_from_git_is_built(releases: Releases, project: Project, origin: Path) -> None:
    flow = FLOW.replace("made/a.py", "a.py").replace("sh build.sh", "touch built")
    project.write("dataflow.yml", f"{flow}\n  git: file://{origin}\n  branch: main\n")
    releases.deploy(project.root, *FAST)
    assert releases.cell.messages("a") == ["version of git"]
    tree = releases.path / releases.current() / "tree"
    assert list(tree.glob("git/**/built"))
    assert not list(tree.glob("git/**/.git"))
    releases.check_whole()


def test_users_build_their_own(cell: Cell) -> None:
    home, name = Home("alice"), cell.name

    def doractl(*words: str) -> str:
        command = shlex.join(("doractl", "--user", *words))
        command = f"XDG_RUNTIME_DIR=/run/user/1000 {command}"
        done = run("su", "alice", "-s", "/bin/sh", "-c", command, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    try:
        home.write("build.sh", BUILD + "touch /home/alice/project/proof || true\n")
        home.write("dataflow.yml", FLOW)
        doractl("deploy", str(home.root), "--name", name, "--no-enable", *FAST)
        (row,) = json.loads(doractl("releases", name, "-o", "json"))
        tree = Path("/home/alice/.local/state/dora-systemd/releases", name, row["release"], "tree")
        assert row["state"] == "current"
        assert (tree / "made/a.py").exists()
        assert f"builds in {tree}" in str(printed(cell, "_SYSTEMD_USER_UNIT"))
    finally:
        doractl("stop", name)
        shutil.rmtree("/home/alice/.local/state/dora-systemd")
        Path("/home/alice/.config/systemd/user", cell.unit).unlink(missing_ok=True)
        shutil.rmtree(home.root)
