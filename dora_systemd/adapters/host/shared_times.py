"""A small file of times that two processes share by mmap(2), without a system call for each."""

import mmap
import os
from pathlib import Path


class SharedTimes:
    """`size` bytes in the file at `path`, all 0 to begin with. Raises OSError."""

    def __init__(self, path: Path, size: int) -> None:
        path.unlink(missing_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(path, flags, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, size)  # else a full file system would be SIGBUS
            self._map = mmap.mmap(descriptor, size)
        finally:
            os.close(descriptor)

    def read(self) -> bytes:
        """What is in the file now."""
        return self._map[:]

    def close(self) -> None:
        """Forget it; the file stays for those who read it by its path."""
        self._map.close()
