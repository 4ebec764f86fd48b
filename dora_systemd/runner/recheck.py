"""Checks in a running cell whether its dataflow could start again.

`doractl restart` asks before it stops anything. The files are checked as the nodes' user, in their
sandbox and with their environment, and the errors are those of a start.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dora_systemd.adapters.runner_socket.client import Request, refused_reply
from dora_systemd.adapters.runner_socket.listener import Answer
from dora_systemd.errors import DoraSystemdError, TimedOut
from dora_systemd.runner.cell.role import Alone
from dora_systemd.runner.check import check_start
from dora_systemd.runner.reload.sources import Sources, check_programs


class Recheck:
    """Answers {"verb": "check"}; `answer` answers all other requests.

    environment: of the nodes.
    """

    def __init__(self, role: Alone, environment: Mapping[str, str], answer: Answer) -> None:
        self._role, self._environment, self._others = role, environment, answer
        role.find_own_refusal = self.find_refusal

    async def answer(self, request: Request) -> dict[str, Any]:
        """Answer one request. Raises DoraSystemdError as `answer` does."""
        if request.get("verb") != "check":
            return await self._others(request)
        refusal = await asyncio.to_thread(self.find_refusal)
        return refused_reply(refusal or await self._role.find_refusal())

    def find_refusal(self) -> DoraSystemdError | None:
        """Check the dataflow; the error that a start would end with, or None."""
        try:
            self._check()
        except TimedOut:
            return None  # a busy machine says nothing about the files
        except DoraSystemdError as error:
            return error
        return None

    def _check(self) -> None:
        role, options = self._role, self._role.options
        _, prepared = check_start(options, role.own(options), self._environment)
        role.check(prepared.dataflow)
        here = replace(prepared, dataflow=role.here(prepared.dataflow))
        files = Sources(options, self._environment).files(here)
        check_programs(sorted(frozenset().union(*files.values())))
