"""A Python that is too old."""

import subprocess
import sys


def test_it_is_named_in_one_line() -> None:
    code = "import sys; sys.version_info = (3, 10, 12); import dora_systemd.cli.main"
    done = subprocess.run((sys.executable, "-c", code), capture_output=True, text=True, check=False)
    line, hint = done.stderr.splitlines()
    assert line == "doractl: cannot run with Python 3.10: 3.11 or newer is needed"
    assert hint.startswith("hint: ")
    assert done.returncode == 1
