"""The store of the releases of one dataflow: a directory for each, which no node can change.

In system scope all of it is root's; the group of the nodes' user may enter a release, other users
may not. In user scope it has no write permissions, against accidents. What is not finished has a
name with a dot in front, and the next deploy removes it.
"""

import contextlib
import fcntl
import os
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.decisions.releases.manifest import (
    Manifest,
    Stored,
    format_manifest,
    parse_manifest,
)
from dora_systemd.decisions.releases.past import (
    MOST_LINES,
    Known,
    Switch,
    count_damaged,
    format_switch,
    kept,
    parse_history,
)
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import STORE, TREE, is_release_id
from dora_systemd.scope import place_hint
from dora_systemd.trust.files import MAX_BYTES, append_lines, read_file, read_lines
from dora_systemd.trust.paths import sync_directory
from dora_systemd.trust.programs import spawn
from dora_systemd.values import shown

if TYPE_CHECKING:
    from concurrent.futures import Future

    Read = Future[Stored | None]

MANIFEST = "release.json"
UNIT = "unit"
_PROVED = "proved"
HISTORY = "history"
_LOCK = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
MOST_MANIFEST = 64 * 1024 * 1024
"""Maximum bytes of release.json: 100,000 files have about 30 MB."""
_REMOVE_SECONDS = 300.0
SYSTEM_STATE = Path("/var/lib")


def store_root(state_root: Path = SYSTEM_STATE) -> Path:
    """The directory of the releases of all dataflows. state_root: that of the scope."""
    return state_root / STORE


class Store:
    """The releases of the dataflow `name`, in the directory `root` / `name`.

    lock: a file that nobody else can open, unlike the directory, which everybody could lock.
    """

    def __init__(self, root: Path, name: str) -> None:
        self.name = name
        self.path = root / name
        self.lock = root / f".{name}.lock"

    def release(self, release_id: str) -> Path:
        """The directory of a release."""
        return self.path / release_id

    def tree(self, release_id: str) -> Path:
        """The directory of the files of a release."""
        return self.release(release_id) / TREE

    def known(self) -> list[Known]:
        """Return all releases, oldest first; unreadable ones count as not proved."""
        found = sorted(filter(is_release_id, self._names()))
        return [Known(one, self.is_proved(one)) for one in found]

    def unfinished(self) -> list[Path]:
        """Find what a killed deploy has left: a release gets its unit file last."""
        return sorted(self.path / name for name in self._names() if self._is_unfinished(name))

    def manifest(self, release_id: str) -> Manifest:
        """The manifest of a release. Raises DoraSystemdError (BAD_INPUT)."""
        text = self._text(release_id, MANIFEST, MOST_MANIFEST)
        return parse_manifest(text, str(self.release(release_id) / MANIFEST))

    def intact(self, manifest: Manifest) -> dict[str, Stored]:
        """Return the files of a release that are unchanged since its manifest was written."""
        with read_by_threads(self.tree(manifest.id), manifest.files) as found:
            return {
                path: one for path, one in manifest.files.items() if one == found[path].result()
            }

    def write_manifest(self, manifest: Manifest) -> None:
        """Replace the manifest of a release. Raises OSError."""
        write_part(self.release(manifest.id), MANIFEST, format_manifest(manifest))

    def unit(self, release_id: str) -> str:
        """The unit file of a release. Raises DoraSystemdError (BAD_INPUT)."""
        return self._text(release_id, UNIT, MAX_BYTES)

    def write_unit(self, release_id: str, text: str) -> None:
        """Write the unit file of a release. Raises OSError."""
        write_part(self.release(release_id), UNIT, text)

    def is_proved(self, release_id: str) -> bool:
        """Whether a release has passed a trial, as far as this user may know."""
        try:
            return (self.release(release_id) / _PROVED).exists()
        except OSError:
            return False

    def prove(self, release_id: str) -> None:
        """Record that a release has passed its trial. Raises OSError."""
        write_part(self.release(release_id), _PROVED, "")

    def doubt(self, release_id: str) -> None:
        """Undo prove(). Raises OSError."""
        (self.release(release_id) / _PROVED).unlink(missing_ok=True)
        sync_directory(self.release(release_id))

    def history(self) -> list[Switch]:
        """The changes of what ran, oldest first. Raises DoraSystemdError (BAD_INPUT)."""
        return parse_history(read_lines(self.path / HISTORY, MAX_BYTES))

    def lost_changes(self) -> int:
        """Count the damaged lines of the history, as far as this user may know.

        Raises DoraSystemdError (BAD_INPUT).
        """
        try:
            return count_damaged(read_lines(self.path / HISTORY, MAX_BYTES))
        except DoraSystemdError as error:
            if error.is_refused:
                return 0
            raise

    def record(self, *switches: Switch) -> None:
        """Append changes of what runs to the history. Raises DoraSystemdError, OSError."""
        append_lines(self.path / HISTORY, b"".join(map(format_switch, switches)))
        if len(history := self.history()) > MOST_LINES:
            stay = kept(history, {one.id for one in self.known()})
            text = b"".join(map(format_switch, stay)).decode()
            write_part(self.path, HISTORY, text)

    def remove(self, release_id: str) -> None:
        """Remove a release: its name goes first, so that no half release is ever listed."""
        gone = self.path / f".old-{release_id}"
        remove_tree(gone)  # of one that was killed
        with contextlib.suppress(FileNotFoundError):
            self.release(release_id).rename(gone)
            remove_tree(gone)

    def remove_all(self) -> None:
        """Remove all releases, and the history last. Raises DoraSystemdError, OSError."""
        for one in self.known():
            self.remove(one.id)
        rest = [*self.path.iterdir()]
        for path in sorted(rest, key=lambda one: one.name == HISTORY):
            remove_tree(path)
        if left := next(self.path.iterdir(), None):
            message = f"cannot remove {shown(str(left))}: something holds or creates files in it"
            raise DoraSystemdError(message, f"see: find {shown(str(left))}")

    def _text(self, release_id: str, name: str, most: int) -> str:
        """Read a file of a release that no caller has named, so no path can be corrected."""
        try:
            return read_file(self.release(release_id) / name, most).data.decode("utf-8", "replace")
        except DoraSystemdError as error:
            if error.is_refused:
                raise
            hint = f"deploy again, or choose another release: doractl releases {self.name}"
            raise bad_input(error.message, hint) from error

    def _names(self) -> list[str]:
        try:
            return [path.name for path in self.path.iterdir()]
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise unusable(self.path, error) from error

    def _is_unfinished(self, name: str) -> bool:
        try:
            is_release = is_release_id(name)
            return name.startswith(".") or (is_release and not (self.path / name / UNIT).exists())
        except OSError:  # others than root may not look into it
            return False


@contextlib.contextmanager
def locked(store: Store, make: bool = True) -> Iterator[None]:
    """Let one process at a time change the store; the kernel ends the lock with the process.

    make: create the directory. Raises DoraSystemdError if another process holds the lock.
    """
    try:
        if make:
            make_directories(store.path.parent)
        fd = os.open(store.lock, _LOCK, 0o600)
    except OSError as error:
        raise unusable(store.path, error) from error
    try:
        _take(fd, store)
        try:
            _require(store, make)
            yield
        finally:
            _leave(store)
    finally:
        os.close(fd)


def is_locked(store: Store) -> bool:
    """Whether a process changes the store now, as far as this user may know."""
    try:
        fd = os.open(store.lock, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _require(store: Store, make: bool) -> None:
    try:
        if make:
            make_directories(store.path)
        store.path.stat()
    except OSError as error:
        raise unusable(store.path, error) from error


def _leave(store: Store) -> None:
    """Remove an empty store, as of a first deploy that was refused, and its lock with it."""
    with contextlib.suppress(OSError):
        store.path.rmdir()
    with contextlib.suppress(OSError):
        if not store.path.exists():
            store.lock.unlink()


def _take(fd: int, store: Store) -> None:
    """Lock the file `fd`, unless another process has it, or has just removed it."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(fd).st_nlink:
            return
    except BlockingIOError:
        pass
    message = f"cannot change the release of {store.name}: another deploy or rollback is at it"
    raise DoraSystemdError(message, "wait until that one has ended")


def make_directories(path: Path) -> None:
    """Create a directory and those above it, which all users may enter. Raises OSError."""
    for one in (*reversed(path.parents), path):
        if not one.exists():
            with contextlib.suppress(FileExistsError):
                one.mkdir(0o755)  # also with a umask of 0: no other user may create files in it
                one.chmod(0o755)


def remove_tree(path: Path) -> None:
    """Remove a file, or a directory with all in it, although it may have no write permissions.

    A build may have filled it: rm(1) follows no link, and removes what is as deep as a path can be.
    """
    if not os.path.lexists(path):
        return
    steps: list[tuple[str, ...]] = [("rm", "-rf", "--one-file-system", "--", str(path))]
    if os.geteuid() != 0:
        # Directories alone: files are hard links of other releases.
        chmod = ("-type", "d", "-exec", "chmod", "u+rwx", "{}", ";")
        steps.insert(0, ("find", str(path), *chmod))
    for command in steps:
        nowhere = subprocess.DEVNULL  # it may complain of each file
        with contextlib.suppress(OSError), spawn(command, None, stderr=nowhere) as child:
            try:
                child.wait(_REMOVE_SECONDS)
            except subprocess.TimeoutExpired:  # something creates files in it meanwhile
                child.kill()


def stored_at(path: Path) -> Stored | None:
    """A file of a release, as a manifest describes it; None if there is none to read."""
    import hashlib

    try:
        if path.is_symlink():
            return Stored(target=str(path.readlink()))
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
    return Stored(status.st_size, bool(status.st_mode & 0o111), digest)


@contextlib.contextmanager
def read_by_threads(tree: Path, paths: Iterable[str]) -> Iterator[dict[str, "Read"]]:
    """Have all processors read files of a release, whose checksums take most of a deploy."""
    # Imported late: it imports logging, and most verbs only list releases.
    from concurrent.futures import ThreadPoolExecutor

    pool = ThreadPoolExecutor(len(os.sched_getaffinity(0)))
    try:
        yield {path: pool.submit(stored_at, tree / path) for path in paths}
    finally:
        pool.shutdown(cancel_futures=True)


def unusable(path: Path, error: OSError) -> DoraSystemdError:
    """The error for a store that cannot be used."""
    code = ExitCode.NO_PERMISSION if isinstance(error, PermissionError) else ExitCode.FAILURE
    message = f"cannot use {shown(str(path))}: {error.strerror}"
    return DoraSystemdError(message, place_hint(path, error), code)


def write_part(directory: Path, name: str, text: str) -> None:
    """Write a file of a release in one step, for its owner only."""
    new = directory / f".{name}"
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    fd = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with os.fdopen(fd, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.rename(directory / name)
    sync_directory(directory)
