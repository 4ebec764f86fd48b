"""The command of `systemctl reload`: requests a reload of what has changed from the unit's runner.

ExecReload= in systemd.service(5) runs it; its exit status is the result of the reload.
"""

import os
import sys
from pathlib import Path

from dora_systemd.adapters.runner_socket.client import done_of, order
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.paths import CellPaths, own_directory

MOST_SECONDS = 24 * 3600.0
"""A bound for the answer. The runner extends TimeoutStartSec= of the unit meanwhile, which would
end this command and not the reload."""


def main() -> int:
    """Request a reload; 0, or the exit status of doractl for the error."""
    directory = own_directory(os.environ)
    try:
        if not directory:
            hint = "systemd runs this: use `doractl reload`"
            raise usage_error("cannot run without RUNTIME_DIRECTORY", hint)
        path = CellPaths(Path(directory)).socket
        done = done_of(path, order(path, {"verb": "reload", "is_job": True}, most=MOST_SECONDS))
    except DoraSystemdError as error:
        print(f"{error.message}\n{error.hint}".strip(), file=sys.stderr)
        return error.code
    print("\n".join(done) or "Nothing has changed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
