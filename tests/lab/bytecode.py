"""The checkout's modules, compiled once for all containers and machines that run them.

A unit finds the checkout read-only, so Python would compile there at each start, and an emulated
processor takes a second for the modules of a runner.
"""

import hashlib
import shutil
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure, find_cache
from lab.image import copy_checkout, tree_environment, tree_layer
from lab.process import run_logged

FOLDERS = ("cli", "dora_systemd", "tests")
ARCHIVE = "bytecode.tar"

# Not checked again: a checkout's times differ, and to read and hash all sources took an eighth of
# the imports of a runner. No test changes a source in the lab. Modules of tests are compiled by
# pytest, in its own way.
_SCRIPT = """\
set -eu
archive=$1 tree=$2
mount --bind "${archive%/*}/src" "$tree/src"
shift 2
chroot "$tree" sh -c 'cd /src && python3 -m compileall -qq --invalidation-mode unchecked-hash \
    -x "/(test_[^/]*|conftest)[.]py$" "$@"' sh "$@"
cd "$tree"
find src -name __pycache__ -print0 | tar --create --file="$archive" --null --files-from=- \
    --owner=0 --group=0 --mode=a+rX
"""


def ensure_bytecode() -> Path:
    """An archive of `__pycache__` directories, by names like src/cli/__pycache__."""
    cache = find_cache()
    return ensure(cache, Layer("bytecode", _key(), lambda path: _build(path, cache))) / ARCHIVE


def _key() -> str:
    texts = hashlib.sha256()
    for folder in FOLDERS:
        for path in sorted((definition.CHECKOUT / folder).rglob("*.py")):
            name = path.relative_to(definition.CHECKOUT)
            texts.update(f"{name}\n".encode() + path.read_bytes())
    return definition.digest(
        definition.tree_key(), definition.read_part(Path(__file__)), texts.hexdigest()
    )


def _build(path: Path, cache: Path) -> None:
    """Without a word: it takes two seconds after each change."""
    tree, log = ensure(cache, tree_layer(cache)), cache / "bytecode.log"
    (path / "src").mkdir()
    copy_checkout(path / "src")
    # In a mount namespace of its own: nothing to unmount, whatever happens.
    words = ["sh", "-c", _SCRIPT, "sh", str(path / ARCHIVE), str(tree), *FOLDERS]
    run_logged(["unshare", "--mount", *words], log, "compile", env=tree_environment(tree))
    shutil.rmtree(path / "src")
