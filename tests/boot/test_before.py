"""The packages, before the reboot: dataflows of the system and of a user are part of the boot."""

import json
import shutil
from functools import partial
from pathlib import Path

from tests.boot.flows import ALICE, BEFORE, NOTES, ROBOT, ROOT, VENV, check_typed, doractl, listed
from tests.deb import packages
from tests.system.cells import run, wait_for

NODE = """
from dora import Node
for event in Node():
    pass
"""
NEVER_READY = "nodes: [{id: only, path: sleep, args: '100000'}]\n"
# Seldom: four of these share one slow processor.
FLOW = "nodes: [{id: only, path: node.py, inputs: {tick: dora/timer/secs/5}}]\n"
BROKEN = """nodes: [{id: only, path: sh, args: "-c 'echo no camera there; exit 3'"}]\n"""


def flow(directory: Path, text: str = FLOW) -> str:
    directory.mkdir(parents=True)
    (directory / "node.py").write_text(NODE)
    path = directory / "dataflow.yml"
    path.write_text(text)
    return str(path)


def start(*words: str) -> None:
    doractl("start", "--venv", str(VENV), *words)


def test_enable() -> None:
    before = sorted(packages.files())
    packages.install()
    packages.make_venv(VENV)
    begun = flow(Path("/srv/begun"))
    start(begun, "--enable", "--no-wait", "--env", "A=x $B %h", "--black-box", "yes")
    start(flow(Path("/srv/running")))
    doractl("enable", "running")
    gone = flow(Path("/srv/gone"))
    start(gone, "--enable", "--no-wait")
    never = flow(Path("/srv/never"), NEVER_READY)
    start(never, "--enable", "--no-wait")
    start(flow(Path("/srv/passing"), NEVER_READY), "--no-wait")
    start(flow(Path("/srv/broken"), BROKEN), "--no-wait")
    is_failed = partial(run, "systemctl", "is-failed", "dora-broken", check=False)
    wait_for("its failure", lambda: not is_failed().returncode, 240)
    user = flow(Path("/home/alice/mine"))
    wait_for("alice's manager", lambda: Path("/run/user/1000/bus").exists(), 120)
    shutil.chown("/home/alice/mine", "alice")
    run(*ALICE, "doractl", "start", user, "--enable", "--venv", str(VENV))
    notes = {name: row["uuid"] for who in (ROOT, ALICE) for name, row in listed(who).items()}
    assert notes.keys() == {"begun", "running", "gone", "never", "mine"}
    Path(gone).unlink()
    NOTES.write_text(json.dumps({**notes, "files": before}))


def test_what_a_person_types_before_it() -> None:
    flow(ROBOT)
    check_typed(BEFORE)
