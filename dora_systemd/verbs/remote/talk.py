"""Runs doractl on hosts by ssh, in parallel: yields its output and its end on each host.

No host can delay the others, or this process: a login, an answer and an idle connection have
timeouts.
"""

import itertools
import os
import select
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from dora_systemd.adapters.ssh import Connection
from dora_systemd.decisions.remote.hosts import Host, Way, remote_command, ssh_arguments
from dora_systemd.decisions.remote.ssh_failures import ending_error, is_of_ssh, mute, silent
from dora_systemd.decisions.remote.stream import AfterMark
from dora_systemd.errors import DoraSystemdError

LOGINS = 8
"""Maximum logins in parallel: sshd drops connections if more than ten have not logged in, see
MaxStartups in sshd_config(5)."""
LOGIN_SECONDS = 15.0
ANSWER_SECONDS = 90.0
"""Timeout of verbs that only read; each of these verbs has shorter timeouts of its own."""
SHORT_SECONDS = 15.0
"""Timeout of `list`, which only queries systemd: a host that hangs must not delay the table."""
AGAIN_SECONDS = 5.0
"""Pause before each attempt to follow a lost host again."""
_TURN_SECONDS = 0.2
_COMPLAINT = 4096


class Said(NamedTuple):
    """Bytes that doractl has written on a host."""

    host: Host
    data: bytes
    is_error: bool


class Ended(NamedTuple):
    """The end of doractl on a host."""

    host: Host
    status: int
    error: DoraSystemdError | None  # why it was not reached, or is lost
    was_in: bool = False  # whether doractl had begun there


Event = Said | Ended | None
"""None: nothing has happened for a moment."""


class Talk:
    """The doractl of one host. most_seconds: for its answer, after the login; None: any time.

    silence: seconds without a byte, in either direction, after which it is given up; None: never.
    opening: what it reads first; None: see Way.
    """

    def __init__(
        self,
        host: Host,
        way: Way,
        words: Sequence[str],
        most_seconds: float | None,
        opening: bytes | None = None,
        silence: float | None = None,
    ) -> None:
        mark = f"doractl-{os.urandom(16).hex()}"
        arguments = ssh_arguments(host, way, remote_command(way, words, mark, host))
        self.host = host
        is_fed = way is Way.FED and opening is None
        self.connection = Connection(arguments, is_fed, is_here=not host.destination)
        self._outbox = itertools.chain([opening or b""])
        self._chunk = b""
        self._has_more = opening is not None
        self._is_told = way is not Way.ONCE
        self._most, self._silence = most_seconds, silence
        self._deadline = time.monotonic() + LOGIN_SECONDS
        self._output, self._errors = AfterMark(mark), AfterMark(mark)
        self._complaint = b""
        self._refusal: DoraSystemdError | None = None
        self._at_end = set[int]()

    @property
    def is_in(self) -> bool:
        """Whether doractl has begun on the host."""
        return self._output.is_open

    def open_fds(self, is_full: bool) -> set[int]:
        """Return the descriptors for poll(2). is_full: whether the host's output can wait."""
        connection = self.connection
        wanted = {connection.errors, connection.ended, *(() if is_full else (connection.output,))}
        return wanted - self._at_end

    def take(self, fd: int) -> list[Said] | None:
        """Read what `fd` has now; None if there is nothing to read."""
        data = self.connection.read(fd)
        if not data:
            self._at_end |= {fd} if data is not None else set()
            return None
        is_error, was_in = fd == self.connection.errors, self.is_in
        shown = (self._errors if is_error else self._output).feed(data)
        if self.is_in and not was_in:
            most = float("inf") if self._most is None else self._most
            self._deadline = time.monotonic() + most
        self._note_life()
        if is_error:
            self._complaint = (self._complaint + shown)[-_COMPLAINT:]
            shown = b"" if is_of_ssh(shown) else shown
        return [Said(self.host, shown, is_error)] if shown else []

    def _note_life(self) -> None:
        if self._silence is not None and self.is_in:
            self._deadline = time.monotonic() + self._silence

    @property
    def wants_to_write(self) -> bool:
        """Whether there is data to write, and the host accepts data."""
        return self._has_more and self.is_in and self.connection.input >= 0

    def say(self, chunks: Iterable[bytes]) -> None:
        """Append chunks to the data to write."""
        self._outbox = itertools.chain(self._outbox, chunks)
        self._has_more = True

    def write(self) -> None:
        """Write without waiting as much as ssh accepts."""
        try:
            self._chunk = self._chunk or next(self._outbox)
            written = self.connection.write(self._chunk)
            self._chunk = self._chunk[written:]
            if written:
                self._note_life()
        except (OSError, StopIteration):  # ssh closed its input; its stderr has the reason
            self._has_more = False

    def end(self) -> Iterator[Said | Ended]:
        """Yield the rest of the output, and the end, after ssh has ended."""
        for fd in (self.connection.output, self.connection.errors):
            while fd not in self._at_end and (said := self.take(fd)) is not None:
                yield from said
        status = self.connection.close()
        complaint = self._complaint if self.is_in else self._errors.noise
        words = (one.decode("utf-8", "replace") for one in (self._output.noise, complaint))
        error = self._refusal or ending_error(self.host, status, self.is_in, *words)
        yield Ended(self.host, status, error, self.is_in)

    def refuse(self, error: DoraSystemdError) -> None:
        """Take no more of its answer."""
        self._refusal = error

    def is_over(self, now: float) -> bool:
        """Whether a bound is reached."""
        return self._refusal is not None or now > self._deadline

    def give_up(self) -> Ended:
        """End a connection that has reached a timeout."""
        status = self.connection.close()
        if self._refusal:
            return Ended(self.host, status, self._refusal, self.is_in)
        most = self._most or self._silence or 0
        what = ("no answer", most) if self.is_in else ("no login", LOGIN_SECONDS)
        error = silent(self.host, what[1], what[0])
        if self.is_in and self._is_told and self._silence is not None:
            error = mute(self.host, self._silence)
        return Ended(self.host, status, error, self.is_in)


class Talks:
    """The connections to several hosts. is_full: whether the output of a host can wait.

    at_once: how many in parallel. opening: the first input of each host. silence: as of Talk.
    """

    def __init__(
        self,
        hosts: Sequence[Host],
        way: Way,
        words: Sequence[str],
        most_seconds: float | None = None,
        is_full: Callable[[str], bool] = lambda _host: False,
        at_once: int | None = None,
        opening: bytes | None = None,
        silence: float | None = None,
    ) -> None:
        self._waiting = deque(hosts)
        self._at_once = at_once or len(hosts)
        self._opening, self._silence = opening, silence
        self._way, self._words, self._most = way, words, most_seconds
        self._again: dict[Host, tuple[float, Sequence[str]]] = {}
        self._is_full = is_full
        self._live: list[Talk] = []
        self._lost: set[Host] = set()
        self._hangs_up = False

    @property
    def is_complete(self) -> bool:
        """Whether every host was reached or given up."""
        is_reached = (one.is_in or one.host in self._lost for one in self._live)
        return not self._waiting and all(is_reached)

    @property
    def present(self) -> list[Host]:
        """The hosts with a connection now."""
        return [one.host for one in self._live]

    def say(self, host: Host, chunks: Iterable[bytes]) -> None:
        for one in self._live:
            if one.host == host:
                one.say(chunks)

    def begin_again(self, host: Host, words: Sequence[str]) -> None:
        """Connect to a lost host again, after AGAIN_SECONDS, with this command."""
        self._lost.add(host)
        self._again[host] = time.monotonic() + AGAIN_SECONDS, words

    def begin_no_more(self) -> None:
        """Drop the hosts that still wait for their turn."""
        self._waiting.clear()
        self._again.clear()

    def hang_up(self) -> None:
        """Close the input of following commands, so that they end after their last output.

        A handler of a signal may call this at any moment, so events() does it: no connection that
        begins just now, and no host that is lost only afterwards, is followed for ever.
        """
        self._hangs_up = True

    def give_up(self, host: Host, error: DoraSystemdError) -> None:
        """End the connection to a host, with this error."""
        for one in self._live:
            if one.host == host:
                one.refuse(error)

    def events(self) -> Iterator[Event]:
        """Yield all events until all hosts have ended. Raises DoraSystemdError without ssh."""
        try:
            while self._waiting or self._live or self._again:
                if self._hangs_up:
                    self._end_all()
                self._admit()
                yield from self._turn()
        finally:
            for one in self._live:
                one.connection.close()

    def _end_all(self) -> None:
        self.begin_no_more()
        for one in self._live:
            one.connection.hang_up()

    def _admit(self) -> None:
        while self._waiting and self._has_room():
            self._begin(self._waiting.popleft(), self._words)
        now = time.monotonic()
        for host in [one for one, (due, _) in self._again.items() if due <= now]:
            _, words = self._again.pop(host)
            self._begin(host, words)

    def _begin(self, host: Host, words: Sequence[str]) -> None:
        more = self._opening, self._silence
        self._live.append(Talk(host, self._way, words, self._most, *more))

    def _has_room(self) -> bool:
        logins = sum(not one.is_in for one in self._live)
        return logins < LOGINS and len(self._live) < self._at_once

    def _turn(self) -> Iterator[Event]:
        talks = {fd: one for one in self._live for fd in one.open_fds(self._is_full(one.host.text))}
        poll = select.poll()
        for fd in talks:
            poll.register(fd, select.POLLIN)
        writers = {one.connection.input: one for one in self._live if one.wants_to_write}
        for fd in writers:
            poll.register(fd, select.POLLOUT)
        ready = [fd for fd, _ in poll.poll(_TURN_SECONDS * 1000)]
        for fd in ready:
            if fd in writers:
                writers[fd].write()
            elif fd != talks[fd].connection.ended:
                yield from talks[fd].take(fd) or ()
        yield from self._ends([one for one in self._live if one.connection.ended in ready])
        yield None

    def _ends(self, ended: Sequence[Talk]) -> Iterator[Event]:
        for one in ended:
            yield from one.end()
            self._live.remove(one)
        now = time.monotonic()
        for one in [one for one in self._live if one.is_over(now)]:
            self._live.remove(one)
            yield one.give_up()
