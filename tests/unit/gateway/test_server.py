"""What all connections of the gateway share."""

import asyncio
import threading

from dora_systemd.gateway.server import Gateway
from dora_systemd.scope import Scope


def test_slow_actions_leave_room_for_others() -> None:
    """Each of these waits for all others, as a page waits while dataflows stop."""
    together = threading.Barrier(40)

    async def serve() -> None:
        await Gateway(Scope(True, 0), "token").run([], 0.0)
        waits = (asyncio.to_thread(together.wait, 20) for _ in range(together.parties))
        assert len(set(await asyncio.gather(*waits))) == together.parties

    asyncio.run(serve())
