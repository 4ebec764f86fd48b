"""Logs arrive on another machine by systemd-journal-upload. By hand: see docs/logs.md.

The image of the lab does not have Debian's package systemd-journal-remote:

    mmdebstrap --variant=extract --include=systemd-journal-remote,libmicrohttpd12t64 trixie /tmp/r
    LAB_OUT=/tmp/r tests/lab/lab run --env JOURNAL_REMOTE=/out -- pytest tests/system/shipping.py
"""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.system.cells import Cell, Project, run, sync_journal, wait_for

ROOT = Path(os.environ["JOURNAL_REMOTE"])
PROGRAMS = ROOT / "usr/lib/systemd"
URL = "http://127.0.0.1:19532"


@contextmanager
def running(name: str, *words: str) -> Iterator[None]:
    libraries = f"{ROOT}/usr/lib/x86_64-linux-gnu:/usr/lib/x86_64-linux-gnu/systemd"
    command = [str(PROGRAMS / name), *words]
    with subprocess.Popen(command, env={**os.environ, "LD_LIBRARY_PATH": libraries}) as child:
        try:
            yield
        finally:
            child.terminate()


def test_lines_and_events_arrive_with_their_fields(
    cell: Cell, project: Project, tmp_path: Path
) -> None:
    remote = tmp_path / "remote.journal"
    listen = (f"--output={remote}", "--split-mode=none", "--listen-http=127.0.0.1:19532")

    def found(*matches: str) -> list[str]:
        own = (f"DORA_DATAFLOW_NAME={cell.name}", *matches)
        words = ["journalctl", f"--file={remote}", "--quiet", "--output=cat", *own]
        return run(*words, check=False).stdout.splitlines()

    with running("systemd-journal-remote", *listen):
        wait_for("the receiver", remote.exists)
        state = tmp_path / "state"
        with running("systemd-journal-upload", f"--url={URL}", f"--save-state={state}"):
            cell.start(project.three_nodes())
            cell.wait_exchanging()
            cell.doractl("stop", cell.name)
            sync_journal()
            wait_for("the end", lambda: found("DORA_EVENT=dataflow-stopped"))
    assert found("DORA_EVENT=node-ready", "DORA_NODE=sink") == ["Node sink is ready"]
    lines = found("DORA_NODE=sink", "DORA_STREAM=stdout")
    assert lines
    here = run(
        "journalctl",
        "-o",
        "cat",
        f"DORA_DATAFLOW_NAME={cell.name}",
        "DORA_STREAM=stdout",
        "DORA_NODE=sink",
    )
    assert lines == here.stdout.splitlines()
