"""Compares versions of the settings file next to a dataflow while the dataflow runs.

Reading settings needs a library that the runner does not load. So the runner starts a child
process, `python3 -m dora_systemd.runner.reload.settings_file BEFORE AFTER PATH`, with two versions
of the file at PATH.
"""

import json
import os
import sys
from pathlib import Path

from dora_systemd.adapters.host import files, process
from dora_systemd.decisions.cell.options import SettingText, format_setting, parse_setting
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.sight import Sight

_SECONDS = 600.0
"""Timeout of the child, which takes 0.3 s. A machine under load can need a hundred times that, and
a refusal would be wrong: nobody saves a file again that is already right."""


class SettingsFile:
    """The file at `path`; `copy` is where the version in use is kept.

    Each version is read once, because an editor may save the file again at any moment.
    """

    def __init__(self, path: str, copy: Path) -> None:
        self.path = path
        self._copy = copy
        self._taken = copy.with_name(f"{copy.name}.read")

    def keep(self) -> None:
        """Keep the file as the version in use. Raises DoraSystemdError."""
        self.take()
        self.accept()

    def take(self) -> None:
        """Read the file. Raises DoraSystemdError."""
        self._taken.unlink(missing_ok=True)
        if Sight().exists(self.path):
            files.write_atomic(self._taken, files.read_text(Path(self.path)), 0o600)

    def accept(self) -> None:
        """Make the version read last the one in use."""
        if self._taken.exists():
            self._taken.replace(self._copy)
        else:
            self._copy.unlink(missing_ok=True)

    def change(self) -> tuple[tuple[SettingText, ...], tuple[str, ...]]:
        """Read the file; return new limits of nodes, and all other keys that have changed.

        Raises DoraSystemdError if the file is not valid.
        """
        self.take()
        versions = (str(self._copy), str(self._taken))
        command = [sys.executable, "-E", "-P", "-m", __name__, *versions, self.path]
        done = process.run_command(command, _SECONDS, os.environ, account=own_account())
        if done.status:
            raise bad_input(done.stderr.strip())
        found = json.loads(done.stdout)
        return tuple(map(parse_setting, found["limits"])), tuple(found["others"])


def main(before: str, after: str, name: str) -> int:
    """Print the differences as JSON. name: the path of the file, for errors."""
    from dora_systemd.decisions.settings.differences import settings_change
    from dora_systemd.decisions.settings.resolve import resolve_settings

    try:
        both = []
        for path in (before, after):
            text = files.read_text(Path(path)) if Path(path).exists() else ""
            document = files.parse_yaml(text, Path(name), allow_empty=True)
            both.append(resolve_settings({}, {}, [(name, document)]))
    except DoraSystemdError as error:
        print(error.message, file=sys.stderr)
        return error.code
    limits, others = settings_change(*both)
    print(json.dumps({"limits": [*map(format_setting, limits)], "others": others}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
