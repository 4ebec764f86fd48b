"""Reads text and YAML, and writes files atomically. No path can make a read hang."""

import contextlib
import errno
import os
from collections.abc import Sequence
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import place_hint
from dora_systemd.trust.files import check_size, read_own_file
from dora_systemd.trust.paths import refusal
from dora_systemd.values import shown

MAX_DEPTH = 64
"""Maximum nesting: libyaml's composer recurses in C; before 0.2.6 some 100,000 levels crash it."""

MAX_VALUES = 100_000
"""Maximum values in a YAML file: a small file can have enough of them to take seconds."""

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors of writing where the caller may not write."""
_WRITE_HINTS = {
    errno.ENOSPC: "the disk is full, see df",
    errno.EDQUOT: "the quota is used up, see quota",
}


def absolute_path(text: str) -> str:
    """The path as systemd requires it: absolute, with ".." and links before it resolved."""
    path = Path(text).absolute()
    return "/" + str(path.resolve() if ".." in path.parts else path).lstrip("/")


def read_text(path: Path) -> str:
    """Read the regular file `path`, at most MAX_BYTES of UTF-8.

    Raises DoraSystemdError (BAD_INPUT) if there is no such file, if it is not a regular file (a
    FIFO would block), or is too large, unreadable or not UTF-8.
    """
    return decoded(read_own_file(path), path)


def decoded(data: bytes, path: Path) -> str:
    """The text that was read from `path`. Raises DoraSystemdError (BAD_INPUT) if not UTF-8."""
    check_size(path, data)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise refusal(path, f"line {line} is not UTF-8", "save it as UTF-8 text") from error


def read_yaml(path: Path, allow_empty: bool = False) -> object:
    """The document in the YAML file `path`, as dora reads it: YAML 1.2, no merge keys, no dates.

    Raises DoraSystemdError (BAD_INPUT) as read_text does, and with the line number if the file is
    not YAML, has several documents, is nested too deeply or repeats a key; also if it is empty,
    unless `allow_empty` (then the result is None). All uses of an anchor give the same object,
    however often it is used: limit any walk over the result.
    """
    return parse_yaml(read_text(path), path, allow_empty)


def find_line(text: str, keys: Sequence[str]) -> int:
    """The line, counted from 1, of the key to which `keys` lead in a YAML document; 0 is unknown.

    text: what parse_yaml() has accepted.
    """
    import yaml

    from dora_systemd.adapters.host.yaml_loader import Loader

    node, line = yaml.compose(text, Loader=Loader), 0
    for name in keys:
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        for key, value in pairs:
            if key.value == name:
                node, line = value, key.start_mark.line + 1
                break
        else:
            break
    return line


def parse_yaml(text: str, path: Path, allow_empty: bool = False) -> object:
    """The document in `text`, parsed as read_yaml does. path: for errors."""
    import yaml

    from dora_systemd.adapters.host.yaml_loader import Loader

    try:
        _check_shape(text, path)
        document = yaml.load(text, Loader=Loader)
    except yaml.YAMLError as error:
        if "maximum nesting depth" in str(error):
            raise _too_deep(path) from error
        raise refusal(path, _yaml_reason(error), "correct the YAML there") from error
    except (ValueError, ArithmeticError, RecursionError, LookupError, AttributeError) as error:
        # PyYAML raises the last two for tags such as `!!float ""` and `!!timestamp x`.
        raise refusal(path, "it is not YAML that can be read", "correct the YAML") from error
    if document is None and not allow_empty:
        raise refusal(path, "it is empty", "write something into it")
    return document


def write_atomic(
    path: Path, data: str | bytes, mode: int = 0o644, is_durable: bool = False
) -> None:
    """Replace `path` by `data` in one step: readers get the complete old or new file.

    `mode` applies from the first byte on, whatever the umask is. is_durable: this holds after a
    power failure as well. On failure raises DoraSystemdError and leaves no temporary file.
    """
    content = data.encode() if isinstance(data, str) else data
    # Not tempfile, which loads every compressor and random numbers.
    temporary = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
    try:
        descriptor = os.open(temporary, _NEW, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(file.fileno(), mode)
            file.write(content)
            if is_durable:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        is_refused = error.errno in REFUSED
        code = ExitCode.NO_PERMISSION if is_refused else ExitCode.FAILURE
        hint = place_hint(path, error) if is_refused else _WRITE_HINTS.get(error.errno or 0, "")
        message = f"cannot write {shown(str(path))}: {error.strerror}"
        raise DoraSystemdError(message, hint, code) from error


def _check_shape(text: str, path: Path) -> None:
    """Check the limits on parser events, which need no recursion, unlike nodes."""
    import yaml

    from dora_systemd.adapters.host.yaml_loader import Loader

    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=Loader)):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _too_deep(path)
        if count > MAX_VALUES:
            raise refusal(path, f"it is more than {MAX_VALUES} values", "make it simpler")


def _too_deep(path: Path) -> DoraSystemdError:
    """The same text for our limit and for that of libyaml 0.2.6, which is 1000 levels."""
    return refusal(path, f"it is nested more than {MAX_DEPTH} levels deep", "make it simpler")


def _yaml_reason(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
    return f"line {mark.line + 1}: {problem}" if mark else f"not YAML: {problem}"
