"""The runner's socket: one line in, one line out, and errors that arrive as they are."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runnersocket import ask, serve


async def answer(request: Mapping[str, Any]) -> dict[str, Any]:
    if request.get("verb") == "broken":
        raise KeyError("node")
    if request.get("verb") == "no":
        raise DoraSystemdError("cannot do it", "do that", ExitCode.NOT_FOUND)
    return {"done": [request.get("verb")]}


def ask_server(path: Path, *requests: bytes | Mapping[str, Any]) -> list[Any]:
    async def talk() -> list[Any]:
        server = asyncio.create_task(serve(path, answer))
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


def test_nobody_there(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="cannot reach the runner of robot: ") as caught:
        ask(tmp_path / "robot/runner.sock", {"verb": "yes"})
    assert caught.value.code == ExitCode.NOT_RUNNING
