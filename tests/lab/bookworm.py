"""LAB=bookworm: Debian 12, with what the Debian packages need there."""

import re
import shutil
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import CERTIFICATES, debian_command, run_in_tree
from lab.process import need_tools, run_logged

# For the tests and for nodes: a user's dataflow has an environment of its own too.
TEST_TOOLS = ["pytest", "pytest-timeout", "dora-rs==1.1.0", "pyarrow", "numpy", "uv"]
# Of these, PyPI has no wheels: `make wheels` builds them, and they need the others.
COMPILED = {"pystemd": ("lxml", "psutil"), "systemd-python": ()}


def ensure_bookworm(cache: Path) -> Path:
    return ensure(cache, Layer("bookworm", bookworm_key(), lambda path: build(path, cache)))


def bookworm_key() -> str:
    sources = [definition.read_part(definition.HERE / name) for name in ("bookworm.py", "setup.sh")]
    packages = [definition.OLD_SUITE, definition.OLD_PACKAGES]
    return definition.digest(packages, TEST_TOOLS, list_wheels(), sources)


def build(path: Path, cache: Path) -> None:
    need_tools("mmdebstrap")
    log = cache / "bookworm.log"
    log.unlink(missing_ok=True)
    path.chmod(0o755)
    suite, packages = definition.OLD_SUITE, definition.OLD_PACKAGES
    with Stage(f"Debian {suite}, {len(packages)} packages"):
        run_logged(debian_command(path, "minbase", packages, suite), log, "install Debian's")
    with Stage("from PyPI what tests and nodes need"):
        install_from_pypi(path, log)
    with Stage("users and units"):
        shutil.copy(definition.HERE / "setup.sh", path / "run/setup.sh")
        run_in_tree(path, ["sh", "/run/setup.sh"], log)
    (path / CERTIFICATES).unlink(missing_ok=True)


def install_from_pypi(path: Path, log: Path) -> None:
    run_in_tree(path, ["python3", "-m", "venv", "--system-site-packages", "/opt/lab"], log)
    run_in_tree(path, ["pip", "install", "--no-cache-dir", *TEST_TOOLS], log)
    # There is no network inside, where uv installs the product.
    only = ["--only-binary=:all:", "--no-cache-dir", "--dest=/opt/wheels"]
    run_in_tree(path, ["pip", "download", *only, *list_wheels()], log)


def list_wheels() -> list[str]:
    """What uv finds on PyPI when it installs the product, and dora's command."""
    found = {re.split("[<>=]", one)[0]: one for one in definition.read_dependencies()}
    more = [name for names in COMPILED.values() for name in names]
    return [
        definition.PYPI[0],
        *(one for name, one in found.items() if name not in COMPILED),
        *more,
    ]
