"""Limits of the nodes' groups; the source is the kernel's "Control Group v2" document."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import CPUS_FILE, read_text, write_text
from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.errors import DoraSystemdError, ExitCode


def limit_groups(groups: Iterable[tuple[Path, NodeLimits]]) -> ExitStack:
    """Set the limits of nodes' groups, all or none; closing the result restores the old limits.

    Raises DoraSystemdError if one does not take effect.
    """
    with ExitStack() as undo:
        for path, limits in groups:
            before = {file: read_text(path / file) for file in limits.files()}
            undo.callback(_restore_group, path, before)
            _limit_group(path, limits)
        return undo.pop_all()


def _limit_group(path: Path, limits: NodeLimits) -> None:
    for file, text in limits.files().items():
        try:
            is_limited = write_text(path / file, text := _written(path, file, text))
            reason = f"its group has no {file}"
        except OSError as error:
            is_limited, reason = False, f"{error.strerror} ({file}: {text})"
        if is_limited and file == CPUS_FILE and text.strip():
            used = read_text(path / f"{file}.effective").strip()
            is_limited, reason = used == text, f"of the cpus {text} it may use {used}"
        if not is_limited and text.strip() and not text.startswith("max"):
            raise DoraSystemdError(
                f"cannot limit the node {limits.node}: {reason}",
                "the kernel or the container does not provide it to this dataflow",
                ExitCode.NO_SYSTEMD,
            )


def _restore_group(path: Path, texts: Mapping[str, str]) -> None:
    """Write back texts, as far as the kernel accepts them."""
    for file, text in texts.items():
        with suppress(OSError):
            write_text(path / file, _written(path, file, text.strip()))


def _written(path: Path, file: str, text: str) -> str:
    """Return the text to write: without CPUs those of the parent group, to prevent EIO."""
    is_empty = file == CPUS_FILE and not text.strip()
    return read_text(f"{path.parent}/{file}.effective").strip() if is_empty else text
