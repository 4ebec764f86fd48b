"""The main process of doranotice@NAME.service: `python3 -m dora_systemd.verbs.notice NAME`."""

import os
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host import notify
from dora_systemd.adapters.journal.reader import Bounds, JournalReader
from dora_systemd.decisions.gateway.place import is_directory_of_user
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import parse_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.notice.dispatch import Dispatcher, read_journal
from dora_systemd.verbs.notice.send import Sender

# Nobody waits for a notice, and after a boot the dataflows have the processor first.
_BOUNDS = Bounds(seconds=20.0)


def main(arguments: Sequence[str]) -> int:
    """Send what is to be sent, and end; return the exit status."""
    place = os.environ.get("RUNTIME_DIRECTORY", "")
    try:
        name = parse_name(arguments[0] if arguments else "")
        scope = Scope(is_user=is_directory_of_user(place), uid=os.getuid())
        manager, journal = Bus(scope), JournalReader(_BOUNDS)
        sender = Sender(manager, scope, name, journal, Path(place))
        sender.learn()
        notify.send_ready()  # from now on systemd may unload the dataflow
        sender.write_after_boot(time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000)
        read = partial(read_journal, journal, scope, name)
        Dispatcher(manager, scope, name, read, sender.learn, sender.send).run()
    except DoraSystemdError as error:
        print(f"<4>{error.message}; {error.hint}", file=sys.stderr)
        return error.code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
