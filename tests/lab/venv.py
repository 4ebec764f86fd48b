"""A venv on the host for what needs no systemd: unit tests and linters."""

import os
import platform
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from lab import definition
from lab.cache import take_lock
from lab.errors import Stage
from lab.process import run_logged

KEEP_VENVS = 10
"""Each checkout has a venv, and several can be at work at the same time."""
# They need a compiler and libsystemd; unit tests never import them.
COMPILED = ("pystemd", "systemd-python")


def ensure_venv(cache: Path, for_system_tests: bool = False) -> Path:
    project = tomllib.loads(definition.read_part(definition.CHECKOUT / "pyproject.toml"))
    packages = list_packages(project, for_system_tests)
    venv = cache / f"venv-{venv_key(packages)}"
    # Not a layer: a venv cannot be renamed, so a file in it says that it is finished.
    lock = take_lock(cache / "venv.lock", 2)
    try:
        if not (venv / "finished").exists():
            build_venv(venv, packages, cache / "venv.log")
            remove_old(cache, venv)
    finally:
        os.close(lock)
    return venv


def list_packages(project: dict[str, Any], for_system_tests: bool) -> list[str]:
    needed = project["project"]["dependencies"]
    tools = project["project"]["optional-dependencies"]["test"]
    # 75 brings its own bdist_wheel; Debian 12 puts an older one into each venv.
    setuptools = "setuptools>=75"
    if for_system_tests:
        return [setuptools, *needed, *tools, *definition.PYPI]
    return [setuptools, *(name for name in needed if not name.startswith(COMPILED)), *tools]


def venv_key(packages: list[str]) -> str:
    pyproject = definition.read_part(definition.CHECKOUT / "pyproject.toml")
    return definition.digest(packages, definition.project_key(pyproject, ""), sys.version,
                             platform.machine(), definition.CHECKOUT)  # fmt: skip


def build_venv(venv: Path, packages: list[str], log: Path) -> None:
    with Stage(f"{len(packages)} Python packages from PyPI into {venv}"):
        shutil.rmtree(venv, ignore_errors=True)
        log.unlink(missing_ok=True)
        run_logged(["/usr/bin/python3", "-m", "venv", str(venv)], log, "make a venv")
        pip = [str(venv / "bin/python"), "-m", "pip", "install"]
        run_logged([*pip, *packages], log, "install from PyPI")
        options = ["--no-deps", "--no-build-isolation", "--editable"]
        run_logged([*pip, *options, str(write_skeleton(venv))], log, "install the checkout")
        (venv / "finished").touch()


def add_package(venv: Path, package: str, without: str) -> None:
    """Install what only one target needs, unless it is there.

    without: a package that it needs for something else, and that would change the other targets.
    """
    note = venv / f"with-{package}-without-{without}"
    if not note.exists():
        pip = [str(venv / "bin/python"), "-m", "pip"]
        with Stage(f"{package} from PyPI into {venv}"):
            run_logged([*pip, "install", package], venv / "more.log", f"install {package}")
            remove = [*pip, "uninstall", "--yes", without]
            run_logged(remove, venv / "more.log", f"remove {without}")
            note.touch()


def write_skeleton(venv: Path) -> Path:
    """The checkout by links, so that setuptools does not write its egg-info into the checkout."""
    skeleton = venv / "checkout"
    skeleton.mkdir()
    for name in ("pyproject.toml", "README.md", "dora_systemd", "cli", "units", "packaging"):
        (skeleton / name).symlink_to(definition.CHECKOUT / name)
    return skeleton


def remove_old(cache: Path, venv: Path) -> None:
    found = [path for path in cache.glob("venv-*") if path != venv]
    found.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for path in found[KEEP_VENVS - 1 :]:
        shutil.rmtree(path)


def venv_environment(venv: Path) -> dict[str, str]:
    """Caches beside the venv: a checkout is not for us to fill."""
    return {
        **os.environ,
        "PATH": f"{venv}/bin:{os.environ['PATH']}",
        "VIRTUAL_ENV": str(venv),
        "PYTHONPYCACHEPREFIX": str(venv / "pycache"),
        "RUFF_CACHE_DIR": str(venv / "ruff"),
        "MYPY_CACHE_DIR": str(venv / "mypy"),
        "PYTEST_ADDOPTS": f"-o cache_dir={venv}/pytest {os.environ.get('PYTEST_ADDOPTS', '')}",
        "HYPOTHESIS_STORAGE_DIRECTORY": str(venv / "hypothesis"),
    }


def run_in_venv(venv: Path, command: list[str], cwd: Path = definition.CHECKOUT) -> int:
    return subprocess.run(command, env=venv_environment(venv), cwd=cwd, check=False).returncode
