"""`doractl run` ends as `dora run` does, however the nodes and the command end."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run

LISTENS = """
import sys, time
from dora import Node
node = Node()
print("up", flush=True)
for event in node:
    if event["type"] == "STOP":
        break
"""
NODES = {
    "well": LISTENS,
    "five-at-stop": LISTENS + "sys.exit(5)\n",
    "crashes": "from dora import Node\nNode()\nraise SystemExit(3)\n",
    "slow": LISTENS.split("for event")[0] + "time.sleep(300)\n",
    "slow-143": LISTENS.split("for event")[0]
    + "import os, signal\nsignal.signal(signal.SIGTERM, lambda *_: os._exit(143))\n"
    + "time.sleep(300)\n",
    "143-at-stop": LISTENS + "sys.exit(143)\n",
    "ends": "from dora import Node\nNode()\n",
    "deaf": LISTENS.split("for event")[0]
    + "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(300)\n",
}
CASES = {
    "well": ("INT", "", 0),
    "five-at-stop": ("INT", "", 1),
    "deaf": ("TERM", "", 1),
    "slow": ("INT", "", 0),
    "slow-143": ("TERM", "", 0),
    "143-at-stop": ("INT", "", 1),
    "crashes": ("INT", "restart_policy: on-failure, restart_delay: 1, max_restarts: 100", 1),
    "ends": ("INT", "", 0),
}
"""The node: the signal that ends the command after some seconds, more keys, and the status."""


@pytest.mark.parametrize("case", CASES)
@pytest.mark.warns("'exit-code'", "crashed", "node_failure", "failed: node one", "was killed")
def test_exit_status(cell: Cell, project: Project, case: str) -> None:
    number, keys, status = CASES[case]
    places = (project, Project(project.root.with_name("bare")))
    for place in places:
        place.write("node.py", NODES[case])
        place.write("dataflow.yml", f"nodes: [{{id: one, path: node.py, {keys}}}]\n")
    flow, other = (str(place.root / "dataflow.yml") for place in places)
    wait = ("timeout", "--preserve-status", f"--signal={number}")
    seconds = f"{max(8, bound(2)):.0f}"  # both have begun then, though they begin together
    own = (seconds, "doractl", "run", flow, "--name", cell.name, "--grace-duration", "1s")
    with ThreadPoolExecutor() as pool:
        # Two signals at once, as timeout sends them without --foreground, make dora itself fail.
        theirs = (*wait, "--foreground", seconds, "dora", "run", other)
        with_dora = pool.submit(run, *theirs, cwd=places[1].root, check=False)
        ours = run(*wait, *own, check=False)
        bare = with_dora.result()
    words = f"{bare.stdout}{bare.stderr}\n{ours.stdout}{ours.stderr}"
    assert (min(bare.returncode, 1), ours.returncode) == (status, status), words
    assert cell.is_gone
