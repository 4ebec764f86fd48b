"""The old name of dora_systemd.runner.reload.request: unit files on machines run it by this one."""

import sys

from dora_systemd.runner.reload.request import main

if __name__ == "__main__":
    sys.exit(main())
