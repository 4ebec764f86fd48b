"""What the image is made of; the key of each layer is a hash of this."""

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[1]

SUITE = "trixie"

# Debian's own build of everything Debian has: the product uses those in its package.
PACKAGES = [
    "systemd", "systemd-sysv", "libpam-systemd", "dbus", "dbus-user-session", "polkitd",
    "python3", "python3-venv", "python3-setuptools", "python3-pystemd", "python3-systemd",
    "python3-pydantic", "python3-click", "python3-yaml", "python3-watchfiles",
    "python3-websockets", "python3-pathspec", "bash-completion",
    "ca-certificates", "curl", "fish", "git", "iproute2", "kmod", "less", "lsof", "make", "man-db",
    "mandoc", "openssh-client", "openssh-server", "psmisc", "procps", "socat",
    "rsync", "strace", "tmux", "udev", "zsh",
]  # fmt: skip

PYPI = [
    "dora-rs-cli==1.1.0", "dora-rs==1.1.0", "pyarrow", "uv", "pytest", "pytest-timeout",
    "hypothesis", "mcap",
]  # fmt: skip

# For nodes that say so by PYTHONPATH. pyarrow imports numpy where it finds it, and a node that
# does not need it then takes twice as long to start: the system tests start 3,000 of them.
NUMPY = "/opt/numpy"
# pip installs it with dora-rs, which never imports it.
UNUSED = ["numpy"]

# What the product's package needs, and no more.
PLATFORM_PACKAGES = [
    "systemd", "systemd-sysv", "libpam-systemd", "dbus", "dbus-user-session", "polkitd",
    "ca-certificates", "iproute2", "openssh-client", "procps", "python3-click", "python3-pathspec",
    "python3-pydantic", "python3-pystemd", "python3-systemd", "python3-venv", "python3-websockets",
    "python3-yaml",
]  # fmt: skip
# Programs that its tests run.
TOOLS = [
    "bash-completion", "curl", "fish", "git", "kmod", "less", "lsof", "man-db", "mandoc", "pipx",
    "psmisc", "rsync", "socat", "strace", "tmux", "udev", "zsh",
]  # fmt: skip

# The oldest Debian that the product works on, and the next one, which is not released yet.
OLD_SUITE, NEW_SUITE = "bookworm", "forky"
# Those beside SUITE, and what only one of them has.
PLATFORMS: dict[str, list[str]] = {OLD_SUITE: [], NEW_SUITE: ["python3-watchfiles"]}

KERNEL = "linux-image-cloud-amd64"

# What `pip install --editable` reads of the checkout, apart from the code it points at.
PROJECT_TABLES = ("build-system", "project")
SYSUSERS = CHECKOUT / "units/templates/dora-systemd.sysusers"


def digest(*parts: object) -> str:
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_part(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def read_dependencies() -> list[str]:
    """What pip installs with the product."""
    project = tomllib.loads(read_part(CHECKOUT / "pyproject.toml"))["project"]
    return list(project["dependencies"])


def base_key() -> str:
    return digest(SUITE, PACKAGES, PYPI, NUMPY, UNUSED, read_part(HERE / "setup.sh"))


def project_key(pyproject: str, sysusers: str) -> str:
    """Settings of linters and pytest change often and do not change the image."""
    tables: dict[str, Any] = tomllib.loads(pyproject)
    wanted = {name: tables.get(name) for name in PROJECT_TABLES}
    setuptools = tables.get("tool", {}).get("setuptools")
    return digest(base_key(), wanted, setuptools, sysusers, read_part(HERE / "image.py"))


def tree_key() -> str:
    return project_key(read_part(CHECKOUT / "pyproject.toml"), read_part(SYSUSERS))
