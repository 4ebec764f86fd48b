"""Projects in the home directories of ordinary users, for tests of what root does with them."""

import os
import pwd
import shutil
from pathlib import Path

from tests.system.cells import run

NODE = """
from dora import Node
for event in Node():
    pass
"""
FLOW = "nodes: [{id: a, path: a.py, inputs: {t: dora/timer/millis/50}}]\n"
SPY = """#!/bin/sh
{ echo "uid $(id -u)"; env; } >>{root}/proof
exec {dora} "$@"
"""


class Home:
    """A project in the home directory of an ordinary user, all of it hers."""

    def __init__(self, user: str) -> None:
        self.user = user
        run("useradd", "--create-home", user, check=False)
        entry = pwd.getpwnam(user)
        self.uid, self.root = entry.pw_uid, Path(entry.pw_dir, "project")
        self.root.mkdir()
        Path(entry.pw_dir).chmod(0o755)
        os.chown(self.root, self.uid, self.uid)
        self.write("a.py", NODE)

    def write(self, name: str, text: str, mode: int = 0o644) -> Path:
        """Write a file that is hers."""
        path = self.root / name
        path.write_text(text)
        path.chmod(mode)
        os.chown(path, self.uid, self.uid)
        return path

    def spy(self) -> Path:
        """A dora of hers that notes who runs it with what."""
        text = SPY.replace("{root}", str(self.root)).replace("{dora}", shutil.which("dora") or "")
        self.write("spy", text, 0o755)
        self.write("dataflow.systemd.yml", "dora: ./spy\nsandbox: none\n")
        return self.write("proof", "", 0o666)
