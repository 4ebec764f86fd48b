"""The old name of dora_systemd.runner.check, for a doractl that an upgrade has replaced."""

import sys

from dora_systemd.runner.check import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
