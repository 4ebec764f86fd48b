"""The runner's socket: lines in and out, errors that arrive as they are, and relays.

Whoever owns the dataflow can put another socket there, and answer root what he likes.
"""

import asyncio
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.runner_socket.client import (
    ask,
    ask_coordinator,
    ask_refusal,
    done_of,
    order,
    refused_reply,
    relay,
)
from dora_systemd.adapters.runner_socket.door import Door, Kept
from dora_systemd.adapters.runner_socket.listener import serve
from dora_systemd.adapters.runner_socket.relay import open_port
from dora_systemd.decisions.dora.protocol import Coordinator, parse_coordinator
from dora_systemd.errors import DoraSystemdError, ExitCode

TOKEN = "0123abc"


def nowhere() -> Coordinator:
    raise DoraSystemdError("cannot reach it", "wait", ExitCode.NOT_RUNNING)


REFUSAL = DoraSystemdError("cannot use \33[1mrobot.yml", "mend it", ExitCode.BAD_INPUT)


async def answer(request: Mapping[str, Any]) -> dict[str, Any]:
    if request.get("verb") == "check":
        return refused_reply(REFUSAL)
    if request.get("verb") == "slow":
        await asyncio.sleep(0.3)
    if request.get("verb") == "broken":
        raise KeyError("node")
    if request.get("verb") == "no":
        raise DoraSystemdError("cannot do it", "do that", ExitCode.NOT_FOUND)
    return {"done": [request.get("verb")]}


def ask_server(path: Path, *requests: bytes | Mapping[str, Any]) -> list[Any]:
    async def talk() -> list[Any]:
        server = asyncio.create_task(serve(path, answer, nowhere))
        while not path.exists():
            await asyncio.sleep(0)
        try:
            answers = [await one_answer(path, request) for request in requests]
            assert path.stat().st_mode & 0o777 == 0o600
            return answers
        finally:
            server.cancel()

    return asyncio.run(talk())


async def one_answer(path: Path, request: bytes | Mapping[str, Any]) -> Any:
    if isinstance(request, bytes):
        reader, writer = await asyncio.open_unix_connection(path)
        writer.write(request)
        line = await reader.readline()
        writer.close()
        return line
    try:
        return await asyncio.to_thread(ask, path, request, 10.0)
    except DoraSystemdError as error:
        return error


def test_answers(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    good, bad, garbage, odd = ask_server(
        path, {"verb": "yes"}, {"verb": "no"}, b"{\n", b'["verb"]\n'
    )
    assert good == {"done": ["yes"]}
    assert (bad.message, bad.hint, bad.code) == ("cannot do it", "do that", ExitCode.NOT_FOUND)
    assert b"cannot read the request" in garbage
    assert odd == b'{"done": [null]}\n'


def test_a_line_without_end_does_no_harm(tmp_path: Path) -> None:
    first, second = ask_server(tmp_path / "s", b"x" * 200_000 + b"\n", {"verb": "yes"})
    assert first == b""
    assert second == {"done": ["yes"]}


def test_a_long_name(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 200) / "runner.sock"
    path.parent.mkdir()
    (answered,) = ask_server(path, {"verb": "yes"})
    assert answered == {"done": ["yes"]}


def test_an_answer_that_breaks_ends_nothing_but_itself(tmp_path: Path) -> None:
    broken, good = ask_server(tmp_path / "s", {"verb": "broken"}, {"verb": "yes"})
    assert broken.message == "cannot do that: KeyError: 'node'"
    assert good == {"done": ["yes"]}


def test_an_order_for_a_runner_whose_coordinator_is_nowhere(tmp_path: Path) -> None:
    with runner(path := tmp_path / "runner.sock", None):
        assert order(path, {"verb": "reload"}) == {"done": ["reload"]}


def test_an_order_for_a_runner_that_is_silent(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        with pytest.raises(DoraSystemdError, match="timed out") as caught:
            order(path, {"verb": "reload"}, 0.05)
    assert caught.value.code == ExitCode.NOT_RUNNING
    assert caught.value.hint == "it may be starting, stopping or frozen; see doractl list"


def test_an_order_takes_as_long_as_its_caller_says(tmp_path: Path) -> None:
    with runner(path := tmp_path / "runner.sock", None):
        with pytest.raises(DoraSystemdError, match="timed out"):
            order(path, {"verb": "slow"}, most=0.01)
        # By its end the first one has ended, too.
        assert order(path, {"verb": "slow"}, most=30) == {"done": ["slow"]}


def test_a_runner_whose_dataflow_could_not_start_again(tmp_path: Path) -> None:
    with runner(path := tmp_path / "runner.sock", None):
        found = ask_refusal(path)
    assert found
    assert "\33" not in found.message
    assert (found.hint, found.code) == (REFUSAL.hint, REFUSAL.code)
    assert refused_reply(None) == {"refused": None}


def test_nobody_there(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="cannot reach the runner of robot: ") as caught:
        ask(tmp_path / "robot/runner.sock", {"verb": "yes"})
    assert caught.value.code == ExitCode.NOT_RUNNING
    assert caught.value.message.endswith(": No such file or directory")


@contextmanager
def runner(path: Path, coordinator: Coordinator | None) -> Iterator[None]:
    """A runner in a thread, whose coordinator is there or not."""
    loop = asyncio.new_event_loop()
    reach = nowhere if coordinator is None else lambda: coordinator
    task = loop.create_task(serve(path, answer, reach))

    def run() -> None:
        with pytest.raises(asyncio.CancelledError):
            loop.run_until_complete(task)
        loop.run_until_complete(end_talks())
        loop.run_until_complete(loop.shutdown_asyncgens())

    thread = threading.Thread(target=run)
    thread.start()
    while not is_listening(path):
        time.sleep(0.001)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(20)
        loop.close()
        path.unlink(missing_ok=True)


async def end_talks() -> None:
    """End what is still connected: else its sockets are closed at some time, in another test."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for one in others:
        one.cancel()
    await asyncio.gather(*others, return_exceptions=True)


def is_listening(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as one:
        return one.connect_ex(str(path)) == 0


@contextmanager
def echo_coordinator() -> Iterator[Coordinator]:
    """It says each chunk twice, and ends when its caller does."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def work() -> None:
            while True:
                try:
                    stream, _ = listener.accept()
                except OSError:
                    return
                with stream:
                    while data := stream.recv(1 << 20):
                        stream.sendall(data + data)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        yield Coordinator(listener.getsockname()[1], TOKEN, 4712)
        listener.shutdown(socket.SHUT_RDWR)
        thread.join(20)


def read_exactly(stream: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count and (more := stream.recv(1 << 20)):
        data += more
    return data


def test_a_relay_is_a_connection_to_the_coordinator(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    with echo_coordinator() as coordinator, runner(path, coordinator):
        assert ask_coordinator(path) == coordinator
        stream, token = relay(path)
        with stream:
            assert (token, stream.gettimeout()) == (TOKEN, None)
            stream.sendall(b"ab")
            assert read_exactly(stream, 4) == b"abab"
            big = os.urandom(2_000_000)
            sender = threading.Thread(target=stream.sendall, args=(big,))
            sender.start()
            assert len(read_exactly(stream, 4_000_000)) == 4_000_000
            sender.join()
            stream.shutdown(socket.SHUT_WR)
            assert stream.recv(1) == b""


def test_a_relay_to_nobody(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    with socket.create_server(("127.0.0.1", 0)) as one:
        closed = Coordinator(one.getsockname()[1], TOKEN, 1)
    for coordinator, message in ((None, "cannot reach it"), (closed, "cannot reach the dora coo")):
        with runner(path, coordinator):
            with pytest.raises(DoraSystemdError, match=message) as caught:
                relay(path)
            assert caught.value.code is ExitCode.NOT_RUNNING
            assert ask(path, {"verb": "yes"}) == {"done": ["yes"]}


class LateDoor(Door):
    """One whose listener is taken over when another file has the number of its directory."""

    def hand_over(self) -> tuple[socket.socket, list[Kept]]:
        listener, kept = super().hand_over()
        number = int(listener.getsockname().split("/")[4])
        other = os.open(os.devnull, os.O_RDONLY)
        self.taken = os.dup2(other, number)
        if other != number:
            os.close(other)
        return listener, kept


def test_another_file_has_the_number_of_the_directory(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    door = LateDoor(path, lambda line: (b"", line))

    async def work() -> None:
        server = asyncio.create_task(serve(path, answer, nowhere, door=door))
        reply = await asyncio.to_thread(ask, path, {"verb": "yes"})
        assert reply == {"done": ["yes"]}
        server.cancel()
        with pytest.raises(asyncio.CancelledError):
            await server

    asyncio.run(work())
    os.close(door.taken)
    assert path.exists()


def test_a_port_that_leads_to_the_relay(tmp_path: Path) -> None:
    """A child listens until this process, and all that it has started, has ended."""
    path, uid = tmp_path / "runner.sock", os.getuid()
    with echo_coordinator() as coordinator, runner(path, coordinator):
        report, told = os.pipe()
        if (pid := os.fork()) == 0:
            for uids in ({uid}, {uid + 1}):
                os.write(told, b"%d " % open_port(path, uids, lambda: None))
            time.sleep(60)
            os._exit(0)
        os.close(told)
        try:
            text = b""
            while text.count(b" ") < 2:
                text += os.read(report, 100)
            mine, others = map(int, text.split())
            with socket.create_connection(("127.0.0.1", mine)) as stream:
                stream.sendall(b"ab")
                assert read_exactly(stream, 4) == b"abab"
            with socket.create_connection(("127.0.0.1", others)) as stream:
                assert stream.recv(1) == b""
        finally:
            os.kill(pid, 9)
            os.waitpid(pid, 0)
        deadline = time.monotonic() + 20
        while is_open(mine) or is_open(others):
            assert time.monotonic() < deadline
            time.sleep(0.01)


def is_open(port: int) -> bool:
    with socket.socket() as stream:
        return stream.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def hostile(path: Path, act: Callable[[socket.socket], object]) -> Iterator[None]:
    """Somebody else's socket in the place of the runner's."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def work() -> None:
            stream, _ = listener.accept()
            with stream:
                try:
                    act(stream)
                except OSError:
                    return

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        yield
        thread.join(20)


LINES = [
    b"[]",
    b"5",
    b"null",
    b"{}",
    b"nonsense",
    b"\xff\xfe",
    b"[" * 60_000,
    b'{"error": 5, "code": 99}',
    b'{"error": {"a": []}, "hint": [], "code": "x"}',
    b'{"error": "no", "code": 1e999}',
    b'{"error": "no", "code": [1]}',
    b'{"error": "\\u001b]0;x\\u0007\\n\\ud800 no", "hint": "\\u009b31m", "code": 0}',
    b'{"token": 5, "port": 1, "done": 5}',
    b'{"token": "a b", "port": -1, "done": [5]}',
    b'{"token": "a\\u001b", "port": 1e999, "local_listen_port": "x"}',
    b'{"port": [], "token": {}, "local_listen_port": NaN}',
    b"x" * 70_000,
    b"",
]


@pytest.mark.parametrize("line", LINES, ids=range(len(LINES)))
@pytest.mark.parametrize(
    "use",
    [
        lambda path: done_of(path, ask(path, {"verb": "reload"})),
        ask_coordinator,
        relay,
    ],
    ids=["reload", "coordinator", "relay"],
)
def test_what_a_hostile_runner_answers(
    tmp_path: Path, use: Callable[[Path], object], line: bytes
) -> None:
    path = tmp_path / "runner.sock"

    def act(stream: socket.socket) -> None:
        stream.recv(1000)
        stream.sendall(line + b"\n" if line else b"")

    with hostile(path, act), pytest.raises(DoraSystemdError) as caught:
        use(path)
    said = caught.value.message + caught.value.hint
    assert said.isprintable(), said
    assert caught.value.message
    assert caught.value.code


def test_an_answer_that_never_ends_and_one_in_drops(tmp_path: Path) -> None:
    def flood(stream: socket.socket) -> None:
        while True:
            stream.sendall(b"x" * 100_000)

    def drip(stream: socket.socket) -> None:
        while True:
            stream.sendall(b"x")
            time.sleep(0.05)

    for number, act in enumerate((flood, drip)):
        path = tmp_path / f"{number}.sock"
        before = time.monotonic()
        with hostile(path, act), pytest.raises(DoraSystemdError) as caught:
            ask(path, {"verb": "yes"}, 0.5)
        assert time.monotonic() - before < 5
        assert caught.value.code is ExitCode.NOT_RUNNING


def test_done_is_shown_without_what_a_terminal_obeys(tmp_path: Path) -> None:
    assert done_of(tmp_path, {"done": ["a\x1b[31m\nä"]}) == ["a\\x1b[31m ä"]


@pytest.mark.parametrize(
    "raw",
    [
        [],
        {},
        {"port": "x", "token": "a", "local_listen_port": 1},
        {"port": True, "token": "a", "local_listen_port": 1},
        {"port": 65536, "token": "a", "local_listen_port": 1},
        {"port": float("inf"), "token": "a", "local_listen_port": 1},
        {"port": 1, "token": "a\n", "local_listen_port": 1},
        {"port": 1, "token": "", "local_listen_port": 1},
        {"port": 1, "token": "a", "local_listen_port": None},
    ],
)
def test_what_can_be_no_coordinator(raw: object) -> None:
    with pytest.raises(ValueError, match="not a"):
        parse_coordinator(raw)


def test_a_coordinator_in_json() -> None:
    one = Coordinator(1, "a", 2)
    assert parse_coordinator(json.loads(json.dumps(one.raw()))) == one
