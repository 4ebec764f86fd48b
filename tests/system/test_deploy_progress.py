"""What doractl deploy and rollback say while they last: on a terminal, in a pipe, for programs."""

import json
import re
import shlex
from pathlib import Path

import pytest

from tests.system.cells import Project, run
from tests.system.releases import Releases, write_version
from tests.system.terminal import shown

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab


def words(releases: Releases, place: Path, *more: str) -> list[str]:
    return ["deploy", str(place), "--name", releases.cell.name, *more]


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_a_pipe_and_a_program(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "1")
    done = cell.doractl(*words(releases, project.root, "--soak", "2s"))
    said = done.stderr
    assert "\r" not in said and "\x1b" not in said
    lines = said.splitlines()
    assert len(lines) == len({*lines})
    assert [line for line in lines if line.startswith("copied: 2 files, ")]
    assert "checking" in lines
    assert "trial: 1/1 nodes ready, soak 0/2 s" in lines
    assert lines[-2:] == [
        "trial: 1/1 nodes ready, soak 2/2 s",
        f"trial of {releases.current()}: passed",
    ]
    assert "trial" not in done.stdout
    # Objects, and the verdict of one that is bad.
    first = releases.current()
    write_version(project, "2", "raise SystemExit(3)\n")
    bad = cell.doractl(*words(releases, project.root, "-o", "json"), check=False)
    assert (bad.returncode, bad.stdout) == (11, "")
    *steps, error = [json.loads(line) for line in bad.stderr.splitlines()]
    found = [one["progress"] for one in steps]
    stages = list(dict.fromkeys(one["stage"] for one in found))
    assert [one for one in stages if one != "stop"] == ["copy", "check", "start", "verdict", "back"]
    assert {one["schema"] for one in steps} == {1}
    copied = [one for one in found if one["stage"] == "copy"][-1]
    assert copied["done_bytes"] == copied["total_bytes"] > 0
    (verdict,) = [one for one in found if one["stage"] == "verdict"]
    assert verdict["passed"] is False
    assert "node a: exit code 3" in verdict["text"]
    assert f"going back to {first}" in found[-1]["text"]
    assert error["error"]["exit_status"] == 11
    # Back to it, and to a reader that goes away at once.
    write_version(project, "3")
    command = shlex.join(["doractl", "--system", *words(releases, project.root, "--soak", "0s")])
    run("bash", "-c", f"set -o pipefail; {command} 2>&1 >/dev/null | true")
    assert releases.running() == releases.current() != first
    silent = cell.doractl("rollback", cell.name, "-q")
    assert (silent.stdout, silent.stderr) == ("", "")
    assert releases.current() == first


def test_a_terminal_has_one_line(releases: Releases, project: Project) -> None:
    write_version(project, "1")
    command = ("doractl", "--system", *words(releases, project.root, "--soak", "2s"))
    text = shown("sh", "-c", 'stty cols 60; exec "$@"', "sh", *command)
    stages = re.findall(r"\x1b\[K([^\n\x1b]*)", text)
    assert "trial: 1/1 nodes ready, soak 1/2 s" in stages
    assert max(map(len, stages[:-1])) < 60
    assert stages[-1].startswith("Dataflow deployed: ")
