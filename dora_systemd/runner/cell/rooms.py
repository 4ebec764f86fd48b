"""The variables of the daemon, which depend on the directories of the cell."""

import os
from pathlib import Path

from dora_systemd.adapters.dora.preparation import PACKAGE, Prepared
from dora_systemd.decisions.cell.launch import has_pipes, python_of
from dora_systemd.paths import CellPaths


def daemon_variables(prepared: Prepared, paths: CellPaths, unit: Path) -> dict[str, str]:
    """Variables of the daemon that nodes do not get; launcher.sh removes them."""
    libexec = str(PACKAGE / "libexec")
    own = {"DORA_QUIET": "1", "RUST_BACKTRACE": "0"}
    added = {key: text for key, text in own.items() if key not in os.environ}
    kept = [node.id for node in prepared.dataflow.nodes if not has_pipes(node)]
    return {
        **added,
        "DORA_SYSTEMD_UNSET": " ".join(("DORA_QUIET", *added)),
        "DORA_SYSTEMD_CELL": str(paths.root),
        "DORA_SYSTEMD_GROUP": str(unit),
        "DORA_SYSTEMD_LIBEXEC": libexec,
        "DORA_SYSTEMD_DIRECTORY": prepared.plan.options.working_directory,
        "DORA_SYSTEMD_PYTHON": python_of(prepared.plan),
        "DORA_SYSTEMD_KEEP": " ".join(kept),
        "PATH": f"{libexec}:{prepared.plan.search_path}",
    }
