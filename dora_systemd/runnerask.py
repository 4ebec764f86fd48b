"""The old name of dora_systemd.runner.reload.request, for unit files that still use it."""

import sys

from dora_systemd.runner.reload.request import main

if __name__ == "__main__":
    sys.exit(main())
