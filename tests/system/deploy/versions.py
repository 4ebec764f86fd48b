"""Bad versions of a project: what is wrong with each, and what `doractl deploy` says of it."""

from collections.abc import Mapping
from typing import NamedTuple

from dora_systemd.errors import ExitCode
from tests.system.releases import FLOW, NODE

READY = """
from dora import Node
node = Node()
"""
# It owes an output, and sends none; nothing else is wrong with it.
OWING = """
nodes:
  - {id: a, path: a.py, inputs: {t: dora/timer/millis/50}, outputs: [image]}
  - {id: b, path: b.py, inputs: {image: a/image, t: dora/timer/secs/1}}
"""


class Version(NamedTuple):
    """A bad version. files: of the project, by name; what is not named is as in the good one.

    says: what deploy prints. flags: of deploy. why: what `why` says of it, "" for what has never
    run. status: of deploy.
    """

    files: Mapping[str, str]
    says: str
    flags: tuple[str, ...] = ("--soak", "20s")
    why: str = ""
    status: ExitCode = ExitCode.ROLLED_BACK


def refused(flow: str, says: str) -> Version:
    """A version that never runs."""
    return Version({"dataflow.yml": flow}, says, status=ExitCode.BAD_INPUT)


def python(text: str, says: str, *flags: str) -> Version:
    """A version with another node."""
    return Version({"a.py": text}, says, flags or ("--soak", "20s"), why=says)


BAD = {
    "syntax-error": python("def (:\n", "node a: exit code 1"),
    "missing-model": python('open("model.onnx")\n' + READY, "node a: exit code 1"),
    "crash-after-5-s": python(
        f"import os, threading\nthreading.Timer(5, os._exit, (7,)).start()\n{NODE}",
        "node a: exit code 7",
    ),
    "silent": Version(
        {
            "dataflow.yml": OWING,
            "b.py": NODE,
            "dataflow.systemd.yml": "nodes: {a: {owes: {output: image, within: 1s, first: 2s}}}\n",
        },
        "node a: silent, no image within 2s of its start",
        ("--soak", "0s"),
        why="node a: silent, no image within 2s of its start",
    ),
    "hang": python(
        f"{READY}\nimport time\ntime.sleep(3600)\n",
        "node a: hung, no WATCHDOG=1 for 2s",
        *("--soak", "20s", "--watchdog", "2s"),
    ),
    "never-ready": python(
        "import time\ntime.sleep(3600)\n",
        "node a was not ready within 3s",
        *("--soak", "0s", "--start-timeout", "3s"),
    ),
    "missing-device": Version(
        {"dataflow.systemd.yml": "nodes: {a: {needs: [/dev/video99]}}\n"},
        "node a: waits for /dev/video99 (not there)",
        why="node a: waits for /dev/video99 (not there)",
    ),
    "missing-program": refused("nodes: [{id: a, path: gone.py}]\n", "gone.py"),
    "dora-refuses": refused(FLOW.replace("inputs", "unknown: 3, inputs"), "unknown field"),
    "no-yaml": refused("nodes: [", "cannot read"),
}
