"""The old name of dora_systemd.runner.reload.settings_file.

A runner goes on through an upgrade, and runs it by the name that it has loaded.
"""

import sys

from dora_systemd.runner.reload.settings_file import main

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
