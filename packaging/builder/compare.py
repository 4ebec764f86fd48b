"""Two builds of one source: the same bytes, or what differs."""

import hashlib
import shutil
from pathlib import Path

from lab.errors import LabError, say

# .buildinfo and .changes tell where and when, that is what they are for.
KINDS = ("*.deb", "*.dsc", "*.tar.*")


def compare_builds(first: Path, second: Path) -> None:
    """Raises LabError if a file that one build made is another in the other, or is not there."""
    one, other = read_digests(first), read_digests(second)
    different = sorted(name for name in {*one, *other} if one.get(name, "") != other.get(name, ""))
    if different:
        pair = [keep(place / different[0]) for place in (first, second)]
        hint = f"diffoscope {pair[0]} {pair[1]}"
        raise LabError(f"build {', '.join(different)} twice with the same bytes", hint)
    say(f"built twice, the same bytes: {', '.join(sorted(one))}")


def keep(path: Path) -> Path:
    """A copy that stays when the build's directory goes."""
    target = Path("/var/tmp") / path.parent.name
    target.mkdir(exist_ok=True)
    return Path(shutil.copy(path, target)) if path.exists() else target / path.name


def read_digests(place: Path) -> dict[str, str]:
    """sha256 of each result by file name."""
    paths = [path for kind in KINDS for path in place.glob(kind)]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def describe(package: Path) -> str:
    """One line about a package."""
    digest = hashlib.sha256(package.read_bytes()).hexdigest()
    return f"{package.name}: {package.stat().st_size / 1e6:.2f} MB, sha256 {digest[:16]}"
