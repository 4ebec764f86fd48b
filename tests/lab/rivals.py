"""LAB=rivals: the tree of LAB=container, and what people supervise programs with otherwise.

For benchmarks only: Debian's Node.js alone is 200 packages that no test needs.
"""

import shutil
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import (
    CERTIFICATES,
    add_dora_user,
    base_layer,
    install_checkout,
    run_in_tree,
    tree_environment,
)
from lab.process import run_logged

VENV = "/opt/rivals"
DEBIAN = ["nodejs", "npm"]
PYPI = ["supervisor==4.3.0", "circus==0.19.0", "setuptools<81"]
NPM = ["pm2@7.0.4"]


def ensure_rivals(cache: Path) -> Path:
    key = definition.digest(definition.tree_key(), definition.read_part(Path(__file__)))
    return ensure(cache, Layer("rivals", key, lambda path: build(path, cache)))


def build(path: Path, cache: Path) -> None:
    """A copy, not links: apt writes into files that it finds."""
    base = ensure(cache, base_layer(cache))
    log = cache / "rivals.log"
    log.unlink(missing_ok=True)
    path.rmdir()
    with Stage(f"supervisord and circus from PyPI, pm2 from npm, {' and '.join(DEBIAN)}"):
        run_logged(["cp", "--archive", str(base), str(path)], log, "copy the base")
        install_rivals(path, log)
    with Stage("editable install of the checkout"):
        add_dora_user(path, log)
        install_checkout(path, log)
    (path / CERTIFICATES).unlink(missing_ok=True)


def install_rivals(path: Path, log: Path) -> None:
    run_in_tree(path, ["apt-get", "update"], log)
    run_in_tree(path, ["apt-get", "install", "-y", "--no-install-recommends", *DEBIAN], log)
    run_in_tree(path, ["apt-get", "clean"], log)
    run_in_tree(path, ["python3", "-m", "venv", VENV], log)
    run_in_tree(path, [f"{VENV}/bin/pip", "install", "--no-cache-dir", *PYPI], log)
    tree_environment(path)  # puts the host's certificates there
    certificates = [f"NODE_EXTRA_CA_CERTS=/{CERTIFICATES}"] * (path / CERTIFICATES).is_file()
    install = ["npm", "install", "--global", "--no-fund", "--no-audit", f"--prefix={VENV}", *NPM]
    run_in_tree(path, [*certificates, *install], log)
    shutil.rmtree(path / "root/.npm", ignore_errors=True)
