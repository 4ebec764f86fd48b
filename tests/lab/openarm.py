"""LAB=openarm: the tree of LAB=container, and what nodes of OpenArm need from PyPI, as wheels."""

from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import CERTIFICATES, add_dora_user, base_layer, install_checkout, run_in_tree
from lab.process import run_logged

WHEELS = "/opt/openarm"
# Left out: what only opencv-python has, which are windows, and what `fastapi[standard]` adds for
# people who write a server. Nothing imports it.
PYPI = [
    "dora-openarm-data-collection-ui==0.4.0", "dora-openarm-dataset-recorder==0.5.0",
    "dora-openarm-dummy==1.0.0", "dora-openarm-dummy-camera==1.0.1", "dora-openarm-quitter==1.0.0",
    "dora-rs==1.1.0", "fastapi==0.165.0", "numpy==2.5.5", "opencv-python-headless==5.0.0.93",
    "pyarrow==26.0.1", "pyyaml==6.0.4", "uvicorn==0.54.0",
    # What those need.
    "annotated-doc==0.0.7", "annotated-types==0.8.0", "anyio==4.16.0", "click==8.5.1",
    "h11==0.16.0", "idna==3.20", "jinja2==3.1.6", "markupsafe==3.0.4",
    "opentelemetry-api==1.45.2", "pydantic==2.14.4", "pydantic-core==2.50.5", "starlette==1.10.0",
    "typing-extensions==4.16.0", "typing-inspection==0.4.5",
]  # fmt: skip


def ensure_openarm(cache: Path) -> Path:
    key = definition.digest(definition.tree_key(), wheelhouse_layer(cache).key)
    return ensure(cache, Layer("openarm", key, lambda path: build_openarm(path, cache)))


def wheelhouse_layer(cache: Path) -> Layer:
    """Apart from the checkout: what changes from day to day takes seconds."""
    key = definition.digest(definition.base_key(), WHEELS, PYPI)
    return Layer("wheelhouse", key, lambda path: build_wheelhouse(path, cache))


def build_wheelhouse(path: Path, cache: Path) -> None:
    log = cache / "openarm.log"
    log.unlink(missing_ok=True)
    # The newer setuptools of a build of its own would not be a version that somebody has chosen.
    build = ["pip", "wheel", "--no-deps", "--no-build-isolation", "--no-cache-dir"]
    with Stage(f"{len(PYPI)} wheels from PyPI for nodes of OpenArm"):
        copy_tree(ensure(cache, base_layer(cache)), path, log)
        run_in_tree(path, [*build, f"--wheel-dir={WHEELS}", *PYPI], log)


def build_openarm(path: Path, cache: Path) -> None:
    log = cache / "openarm.log"
    with Stage("editable install of the checkout"):
        copy_tree(ensure(cache, wheelhouse_layer(cache)), path, log)
        add_dora_user(path, log)
        install_checkout(path, log)
    (path / CERTIFICATES).unlink(missing_ok=True)


def copy_tree(source: Path, target: Path, log: Path) -> None:
    """By hard links: pip and useradd replace files, they do not rewrite them."""
    target.rmdir()
    run_logged(["cp", "--archive", "--link", str(source), str(target)], log, f"copy {source}")
