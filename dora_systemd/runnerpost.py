"""The old name of dora_systemd.runner.stop_post, for unit files that still use it."""

import sys

from dora_systemd.runner.stop_post import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
