"""What root runs of others for a terminal does not get root's own."""

import os
import shutil

import pytest

from tests.system.cells import Cell, Project

pytestmark = pytest.mark.lab

SLEEPER = "nodes: [{id: a, path: a.py, inputs: {tick: dora/timer/secs/1}}]\n"
NODE = "from dora import Node\nfor _event in Node():\n    pass\n"
HERS = """#!/usr/bin/python3
import os, sys
if "whose" in sys.argv:
    print(os.getuid(), os.getsid(0) == os.getpid(), os.isatty(os.open("/dev/tty", os.O_RDWR)))
    sys.exit(7)
os.execv("DORA", sys.argv)
""".replace("DORA", shutil.which("dora") or "")


def test_a_dora_of_others_is_in_a_session_of_its_own(cell: Cell, project: Project) -> None:
    """In root's it could type for root, and go on reading what root types."""
    project.write("a.py", NODE)
    project.write("hers", HERS).chmod(0o755)
    project.write("dataflow.systemd.yml", "dora: ./hers\n")
    flow = project.write("dataflow.yml", SLEEPER)
    for path in (project.root, *project.root.iterdir()):
        os.chown(path, 1000, 1000)
    cell.start(flow, "--uid", "alice")
    done = cell.doractl("dora", cell.name, "--", "whose", check=False)
    assert done.stdout == "1000 True True\n", done.stderr
    assert done.returncode == 7
    assert cell.name in cell.doractl("dora", cell.name, "--", "list").stdout
