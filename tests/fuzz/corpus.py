"""The kept inputs of each target, a file each: good examples, and all that once broke it."""

import hashlib
from pathlib import Path

CORPUS = Path(__file__).with_name("corpus")


def kept(target: str) -> list[bytes]:
    """The inputs of a target, in the order of their names."""
    return [path.read_bytes() for path in sorted((CORPUS / target).glob("*"))]


def keep(target: str, data: bytes) -> Path:
    """Add an input; its name is a part of its hash, so nothing is there twice."""
    path = CORPUS / target / hashlib.sha256(data).hexdigest()[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
