"""Whether the head reaches zenoh of its members, with `link: direct`.

dora starts a run that nobody can hear: what keeps daemons apart, such as a firewall, is no error to
it. So the head looks before each run. zenoh says nothing of a connection that ends at once.
"""

import asyncio
from collections.abc import Mapping

from dora_systemd.decisions.machines.address import endpoint
from dora_systemd.errors import words_of

_SECONDS = 3.0

Endpoints = Mapping[str, tuple[str, int]]
"""Address and port by machine."""


async def unreached(endpoints: Endpoints) -> dict[str, str]:
    """The machines that cannot be reached, and why."""
    found = await asyncio.gather(*(_problem(*one) for one in endpoints.values()))
    return {name: why for name, why in zip(endpoints, found, strict=True) if why}


async def _problem(address: str, port: int) -> str:
    try:
        async with asyncio.timeout(_SECONDS):
            _, writer = await asyncio.open_connection(address, port)
        writer.close()
    except TimeoutError:
        return f"cannot connect to {endpoint(address, port)}: timed out"
    except OSError as error:
        return f"cannot connect to {endpoint(address, port)}: {words_of(error)}"
    return ""
