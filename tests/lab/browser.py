"""LAB=browser: the tree of LAB=container with podman, and Chromium for tests of the status page.

axe-core, which judges whether everybody can use the page, is in a package of PyPI.
"""

from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import CERTIFICATES, add_dora_user, base_layer, install_checkout, run_in_tree
from lab.process import run_logged

# Without windows, and without the toolkit that Chromium proper brings for them.
DEBIAN = ["chromium-headless-shell", "fonts-dejavu-core", "podman", "uidmap"]
PYPI = ["axe-playwright-python==0.1.8"]
AXE = "/opt/axe"
# A boot starts none of what podman brings.
UNITS = ["podman.socket", "podman.service", "podman-restart.service", "podman-auto-update.timer"]


def ensure_browser(cache: Path) -> Path:
    key = definition.digest(definition.tree_key(), chromium_layer(cache).key)
    return ensure(cache, Layer("browser", key, lambda path: build_browser(path, cache)))


def chromium_layer(cache: Path) -> Layer:
    """Apart from the checkout: what changes from day to day takes seconds."""
    key = definition.digest(definition.base_key(), definition.read_part(Path(__file__)))
    return Layer("chromium", key, lambda path: build_chromium(path, cache))


def build_chromium(path: Path, cache: Path) -> None:
    """A copy, not links: apt writes into files that it finds."""
    base = ensure(cache, base_layer(cache))
    log = cache / "browser.log"
    log.unlink(missing_ok=True)
    path.rmdir()
    with Stage(f"{', '.join(DEBIAN)} from Debian, {PYPI[0]} from PyPI"):
        run_logged(["cp", "--archive", str(base), str(path)], log, "copy the base")
        run_in_tree(path, ["apt-get", "update"], log)
        run_in_tree(path, ["apt-get", "install", "-y", "--no-install-recommends", *DEBIAN], log)
        run_in_tree(path, ["apt-get", "clean"], log)
        apart = ["--no-cache-dir", "--no-deps", f"--target={AXE}"]
        run_in_tree(path, ["pip", "install", *apart, *PYPI], log)
        for where in ([], ["--global"]):
            run_in_tree(path, ["systemctl", *where, "disable", *UNITS], log)


def build_browser(path: Path, cache: Path) -> None:
    chromium = ensure(cache, chromium_layer(cache))
    log = cache / "browser.log"
    path.rmdir()
    with Stage("editable install of the checkout"):
        run_logged(["cp", "--archive", "--link", str(chromium), str(path)], log, "copy Chromium's")
        add_dora_user(path, log)
        install_checkout(path, log)
    (path / CERTIFICATES).unlink(missing_ok=True)
