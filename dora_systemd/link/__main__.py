"""The main process of a link: it takes the words of the head's runner to a member, and back.

It ends with its ssh(1), and systemd starts it again: each connection begins with the ports and the
part that the runner gives then. A machine that is away is no failure of the link.
"""

import os
import sys
import time
from pathlib import Path

from dora_systemd.decisions.machines.link_command import (
    LinkOptions,
    parse_link_argv,
    ssh_link_arguments,
)
from dora_systemd.decisions.machines.wire import Refused
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.link.greeting import Greeted, greeted
from dora_systemd.link.program import Program
from dora_systemd.link.talk import Talk, tell
from dora_systemd.link.watchdog import Watchdog
from dora_systemd.trust.paths import exists

_FIRST_SECONDS, _LATER_SECONDS = 0.01, 0.25
_QUICK_TRIES = 500


def main() -> int:
    """Carry until ssh or the runner has ended; the exit status."""
    try:
        link = parse_link_argv(sys.argv[1:])
        return _carry(link)
    except DoraSystemdError as error:
        print(f"{error.message}; hint: {error.hint}", file=sys.stderr)
        return error.code


def _carry(link: LinkOptions) -> int:
    tries, watchdog = 0, Watchdog()
    while (found := greeted(Path(link.socket), link.machine)) is None:
        watchdog.feed()
        # The runner starts, or waits for its restart: systemd ends this unit if it does neither.
        time.sleep(_FIRST_SECONDS if tries < _QUICK_TRIES else _LATER_SECONDS)
        tries += 1
    with found.runner:
        try:
            _connect(link, found, watchdog)
        except DoraSystemdError as error:
            tell(found.runner, Refused(error.message, error.hint))
    return ExitCode.OK


def _connect(link: LinkOptions, found: Greeted, watchdog: Watchdog) -> None:
    """Run ssh until either end has ended. Raises DoraSystemdError if that is of no use."""
    if link.identity and not exists(Path(link.identity)):
        # ssh would say nothing, and log in with another key.
        message = f"cannot log in: the key {link.identity} is gone"
        hint = f"doractl machine remove --force {link.machine}, then doractl machine add"
        raise DoraSystemdError(message, hint, ExitCode.NO_HOST)
    mark = f"doralink-{os.urandom(16).hex()}"
    arguments = ssh_link_arguments(link, found.forwards, mark)
    try:
        ssh = Program("ssh", arguments)
    except OSError as error:
        message = f"cannot execute ssh: {error.strerror}"
        raise DoraSystemdError(message, "apt install openssh-client", ExitCode.NO_HOST) from error
    with ssh:
        talk = Talk(found.runner, ssh, mark, found.rest, watchdog.feed)
        talk.carry()
        talk.part_from(link.host, ssh.end())


if __name__ == "__main__":
    sys.exit(main())
