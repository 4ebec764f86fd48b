"""`make canary`: what changes with another dora than the one that the tests are pinned to.

python -m tests.canary [VERSION]; without one, the newest on PyPI. In a container whose dora is
replaced by that: `dora --help` beside the stored tree, the same dataflows under `dora run` and
`doractl run`, and the dora command at the gateway.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

LAB = Path(__file__).parents[1] / "lab/lab"
PACKAGES = ("dora-rs-cli", "dora-rs")
TESTS = (
    *("test_fidelity.py", "test_fidelity_exit.py", "test_fidelity_output.py", "fidelity"),
    *("test_gateway.py", "test_gateway_dora.py", "test_gateway_env.py"),
)
INSIDE = """
pip install --quiet --no-deps --no-index /out/*.whl
dora --version
status=0
python -m tests.canary.help_tree || status=1
pytest -q --tb=line -rfE "$@" || status=1
exit $status
"""


def main(arguments: Sequence[str]) -> int:
    """Download dora, and try it; 1 if something differs."""
    pin = f"=={arguments[0]}" if arguments else ""
    with tempfile.TemporaryDirectory(prefix="canary-") as place:
        names = [f"{name}{pin}" for name in PACKAGES]
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        done = subprocess.run([*pip, "--only-binary=:all:", f"--dest={place}", *names], check=False)
        if done.returncode:
            return done.returncode
        tests = [f"tests/system/{name}" for name in TESTS]
        run = [str(LAB), "run", "--", "sh", "-euc", INSIDE, "sh", *tests]
        env = {**os.environ, "LAB": "container", "LAB_OUT": place}
        return subprocess.run(run, env=env, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
