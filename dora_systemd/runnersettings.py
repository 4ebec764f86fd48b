"""The settings file beside a dataflow, when it changes while the dataflow runs.

Reading settings takes a library that the runner does without, so a child of it does that:
`python3 -m dora_systemd.runnersettings BEFORE AFTER`.
"""

import json
import os
import shutil
import sys
from pathlib import Path

from dora_systemd import process
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.hotreload import SettingsChange
from dora_systemd.limits import format_node_limits, parse_node_limits
from dora_systemd.trust.programs import own_account

_SECONDS = 120.0


class SettingsFile:
    """The file at `path`; `copy` is where the version that is in use is kept."""

    def __init__(self, path: str, copy: Path) -> None:
        self.path = path
        self._copy = copy

    def keep(self) -> None:
        """The file as it is now is in use. Raises OSError."""
        self._copy.unlink(missing_ok=True)
        if Path(self.path).exists():
            shutil.copyfile(self.path, self._copy)

    def change(self) -> SettingsChange:
        """What has changed since. Raises DoraSystemdError when the file cannot be used."""
        command = [sys.executable, "-E", "-P", "-m", __name__, str(self._copy), self.path]
        done = process.run_command(command, _SECONDS, os.environ, account=own_account())
        if done.status:
            raise DoraSystemdError(done.stderr.strip(), "", ExitCode.BAD_INPUT)
        found = json.loads(done.stdout)
        limits = tuple(map(parse_node_limits, found["limits"]))
        return SettingsChange(limits, tuple(found["others"]))


def main(before: str, after: str) -> int:
    """Print what is different as JSON."""
    from dora_systemd.files import read_yaml
    from dora_systemd.settings import resolve_settings
    from dora_systemd.settingschange import settings_change

    try:
        both = []
        for path in (before, after):
            document = read_yaml(Path(path), allow_empty=True) if Path(path).exists() else None
            both.append(resolve_settings({}, {}, [(after, document)]))
    except DoraSystemdError as error:
        print(error.message, file=sys.stderr)
        return error.code
    change = settings_change(*both)
    limits = [format_node_limits(one) for one in change.limits]
    print(json.dumps({"limits": limits, "others": change.others}))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
