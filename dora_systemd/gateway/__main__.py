"""The main process of dora-gateway.service: `python3 -m dora_systemd.gateway`.

The gateway is a front end. Its only state is a token, nothing depends on it, and it exits when it
is idle. systemd keeps the port open and starts it again, see systemd.socket(5).
"""

import argparse
import asyncio
import logging
import os
import secrets
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.host import notify
from dora_systemd.adapters.host.files import read_text, write_atomic
from dora_systemd.decisions.gateway.place import is_directory_of_user, token_path
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.live.actions import ACTIONS
from dora_systemd.gateway.server import Gateway
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND, parse_duration

_MIN_TOKEN = 32


def main(arguments: Sequence[str]) -> int:
    """Serve until idle or stopped by a signal; return the exit status."""
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    try:
        idle = parse_arguments(arguments)
        asyncio.run(_serve(find_scope(), idle))
    except DoraSystemdError as error:
        print(f"dora-gateway: {error.message}; {error.hint}", file=sys.stderr)
        return error.code
    return ExitCode.OK


def parse_arguments(arguments: Sequence[str]) -> float:
    """Return the idle time in seconds after which the gateway exits."""
    parser = argparse.ArgumentParser("dora-gateway", description="see dora-systemd-security(7)")
    parser.add_argument("--exit-idle-time", default="60s", metavar="DURATION")
    given = parser.parse_args(arguments).exit_idle_time
    return parse_duration(given) / SECOND


def find_scope() -> Scope:
    """The scope of this gateway: a user's manager has its directories below /run/user."""
    directory = os.environ.get("RUNTIME_DIRECTORY", "")
    return Scope(is_user=is_directory_of_user(directory), uid=os.getuid())


def ensure_token(path: Path) -> str:
    """The token of this gateway, created if it is missing. Raises DoraSystemdError."""
    with suppress(DoraSystemdError):
        token = read_text(path).strip()
        if len(token) >= _MIN_TOKEN:
            return token
    token = secrets.token_hex(_MIN_TOKEN)
    write_atomic(path, f"{token}\n", 0o600)
    return token


async def _serve(scope: Scope, idle: float) -> None:
    sockets = notify.activated_sockets()
    if not sockets:
        hint = "doractl up opens the port; systemd starts the gateway then"
        raise DoraSystemdError("cannot serve: systemd has passed no socket", hint)
    gateway = Gateway(scope, ensure_token(token_path(scope)))
    task = asyncio.ensure_future(gateway.run(sockets, idle))

    def end() -> None:
        ACTIONS.end()
        task.cancel()

    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, end)
    notify.send_ready()
    with suppress(asyncio.CancelledError):
        await task
    notify.send_stopping()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
