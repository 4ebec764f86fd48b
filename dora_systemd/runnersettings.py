"""The old name of dora_systemd.runner.reload.settings_file.

A runner that was started before an upgrade has loaded this name, and still runs it.
"""

import sys

from dora_systemd.runner.reload.settings_file import main

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
