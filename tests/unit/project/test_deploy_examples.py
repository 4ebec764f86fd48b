"""The examples of a hook and of a CI job: shells and parsers read them; the lab runs the hook."""

import re
import subprocess

import pytest
import yaml

from tests.unit.checkout import CHECKOUT
from tests.unit.project.test_examples import commands, problem
from tests.unit.project.test_manpages import sections

PLACE = CHECKOUT / "examples/deploy"
HOOK = (PLACE / "post-receive").read_text()
JOB = yaml.safe_load((PLACE / "ci.yml").read_text())
STEPS = [one["run"] for one in JOB["jobs"]["deploy"]["steps"] if "run" in one]


@pytest.mark.parametrize("script", [HOOK, *STEPS], ids=["hook", "key", "copy", "deploy"])
def test_scripts_are_sound(script: str) -> None:
    done = subprocess.run(
        ["sh", "-n"], input=script, text=True, stderr=subprocess.PIPE, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_their_commands_exist() -> None:
    lines = [one for one in (*HOOK.splitlines(), *STEPS) if "doractl" in one]
    lines = [re.sub(r"^.*?(/usr/bin/)?doractl", "doractl", one) for one in lines]
    found = [words for line in lines if "deploy" in line for words in commands(line)]
    calls = [words for words in found if "--soak" in words]
    assert len(calls) == 4
    assert not [told for words in calls if (told := problem(words))]


def test_who_does_what() -> None:
    assert (PLACE / "post-receive").stat().st_mode & 0o111
    assert JOB["jobs"]["deploy"]["steps"][0]["with"] == {"persist-credentials": False}
    assert "root@" not in HOOK + "".join(STEPS)
    assert "examples/deploy" in sections("dora-systemd-releases.7")["EXAMPLES"]
