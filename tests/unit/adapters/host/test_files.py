"""Files of every kind that a path can name; YAML as dora reads it; atomic writes."""

import errno
import os
import signal
import stat
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dora_systemd.adapters.host.files import (
    MAX_DEPTH,
    MAX_VALUES,
    read_text,
    read_yaml,
    write_atomic,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.files import MAX_BYTES


@pytest.fixture
def yaml(tmp_path: Path) -> Any:
    def read(text: str | bytes) -> object:
        path = tmp_path / "x.yml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_yaml(path)

    return read


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: on", {"a": "on"}),
        ("a: yes", {"a": "yes"}),
        ("a: true", {"a": True}),
        ("a: False", {"a": False}),
        ("a: 010", {"a": 10}),
        ("a: 0o10", {"a": 8}),
        ("a: 0x1F", {"a": 31}),
        ("a: 1:30", {"a": "1:30"}),
        ("a: 1_000", {"a": "1_000"}),
        ("a: 1e3", {"a": 1000.0}),
        ("a: .5", {"a": 0.5}),
        ("a: 2024-01-01", {"a": "2024-01-01"}),
        ("a: ~", {"a": None}),
        ("a:", {"a": None}),
        ("<<: {b: 1}", {"<<": {"b": 1}}),
        ('"1": 2', {"1": 2}),
        ("\ufeffa: 1", {"a": 1}),
        ("{a: &x [1], b: *x}", {"a": [1], "b": [1]}),
    ],
)
def test_yaml_as_dora_reads_it(yaml: Any, text: str, value: object) -> None:
    assert yaml(text) == value


@pytest.mark.parametrize(
    ("text", "value"), [("null", "null"), ("Null", "Null"), ("~", None), ("", None), ("5", "5")]
)
def test_an_id_as_dora_reads_it(yaml: Any, text: str, value: str | None) -> None:
    """A node must have an id, so the word null is one; a node need not have a build."""
    (node,) = yaml(f"nodes: [{{id: {text}, build: null}}]")["nodes"]
    assert node == {"id": value, "build": None}


def test_texts_of_nodes_stay_as_written(yaml: Any) -> None:
    node = "{id: 1.10, path: true, args: 1.50, outputs: [007, x], env: {A: 1.50}, build: ~}"
    assert yaml(f"nodes: [{node}]\nargs: 1.50") == {
        "nodes": [
            {"id": "1.10", "path": "true", "args": "1.50", "outputs": ["007", "x"]}
            | {"env": {"A": 1.5}, "build": None}
        ],
        "args": 1.5,
    }


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "it is empty"),
        ("# only a comment\n", "it is empty"),
        ("a: 1\nb: [", "line 3: "),
        ("a: b: c", "line 1: mapping values are not allowed"),
        ("a: 1\nb: 2\na: 3\n", "line 3: duplicate key 'a'"),
        ("a:\n  b: 1\n  b: 1\n", "line 3: duplicate key 'b'"),
        (b"a: 1\nb: \xff\n", "line 2 is not UTF-8"),
        (b"a: \0", "not YAML: "),
        ("--- 1\n--- 2\n", "found another document"),
        ("a: !!python/object/apply:os.system [id]", "line 1: could not determine"),
        ("? [1]\n: 2\n", "line 1: found unhashable key"),
        ("a: *b", "line 1: found undefined alias"),
        ("a: " + "9" * 10000, "it is not YAML that can be read"),
        ("a: !!int x", "it is not YAML that can be read"),
        ("[" * 500_000, f"it is nested more than {MAX_DEPTH} levels deep"),
        ("- " * 500_000 + "x", f"it is nested more than {MAX_DEPTH} levels deep"),
        ("1," * 60_000, ""),
        ("[" + "1," * MAX_VALUES + "1]", f"it is more than {MAX_VALUES} values"),
    ],
)
def test_bad_yaml(yaml: Any, text: str | bytes, reason: str) -> None:
    if not reason:
        assert yaml(text)
        return
    with pytest.raises(DoraSystemdError, match=r"^cannot read .*/x\.yml: ") as caught:
        yaml(text)
    assert reason in caught.value.message
    assert caught.value.code == ExitCode.BAD_INPUT
    assert caught.value.hint


@pytest.mark.parametrize("value", ["!!float ''", "!!float _", "!!timestamp x", "!!int ''"])
def test_a_tag_that_does_not_fit_its_value(yaml: Any, value: str) -> None:
    with pytest.raises(DoraSystemdError, match="it is not YAML that can be read"):
        yaml(f"a: {value}")


def test_empty_yaml_may_be_allowed(tmp_path: Path) -> None:
    path = tmp_path / "x.yml"
    path.write_text("# all of it is a comment\n")
    assert read_yaml(path, allow_empty=True) is None


@pytest.mark.parametrize("merge", ["<<", "!!merge <<"])
def test_bombs_stay_small(yaml: Any, merge: str) -> None:
    """The same anchor is one object, and merge keys are not merged."""
    lines = ["m0: &m0 {a: 1}"]
    lines += [f"m{i}: &m{i}\n  {merge}: [{', '.join([f'*m{i - 1}'] * 10)}]" for i in range(1, 30)]
    try:
        document = yaml("\n".join(lines))
    except DoraSystemdError:
        return
    assert document["m29"]["<<"][0] is document["m28"]


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="there is no such file"):
        read_text(tmp_path / "x")


def test_a_directory(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="it is a directory"):
        read_text(tmp_path)


def test_a_fifo_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x")
    signal.alarm(5)
    with pytest.raises(DoraSystemdError, match="it is not a regular file"):
        read_text(tmp_path / "x")
    signal.alarm(0)


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null"])
def test_a_device(path: str) -> None:
    with pytest.raises(DoraSystemdError, match="it is not a regular file"):
        read_text(Path(path))


@pytest.mark.parametrize("path", ["a\0b", "x" * 300, "/proc/self/mem", "", "/etc/passwd/x"])
def test_odd_paths(path: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        read_text(Path(path))
    assert caught.value.message.isprintable()


def test_a_circle_of_links(tmp_path: Path) -> None:
    (tmp_path / "x").symlink_to("x")
    with pytest.raises(DoraSystemdError, match="circle"):
        read_text(tmp_path / "x")


def test_a_large_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with path.open("wb") as file:
        file.truncate(100 * 1024**3)
    with pytest.raises(DoraSystemdError, match="larger than 1024 KiB"):
        read_text(path)


def test_the_largest_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"x" * MAX_BYTES)
    assert len(read_text(path)) == MAX_BYTES


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary() | st.text(alphabet="[]{}:,-&*!?|>%@`'\"# \nab1").map(str.encode))
def test_any_bytes_are_yaml_or_refused(yaml: Any, data: bytes) -> None:
    try:
        yaml(data)
    except DoraSystemdError as error:
        assert error.message.startswith("cannot read")


def test_a_write_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_atomic(path, "one", 0o600)
    first = path.stat()
    write_atomic(path, b"two", 0o644)
    assert path.read_text() == "two"
    assert stat.S_IMODE(first.st_mode) == 0o600
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert path.stat().st_ino != first.st_ino
    assert [one.name for one in tmp_path.iterdir()] == ["x"]


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    with pytest.raises(DoraSystemdError, match=r"^cannot write .*/x: "):
        write_atomic(tmp_path / "x", "text")
    with pytest.raises(DoraSystemdError, match=r"^cannot write .*/no/x: "):
        write_atomic(tmp_path / "no" / "x", "text")
    assert [one.name for one in tmp_path.iterdir()] == ["x"]


def test_a_refused_write_says_what_is_possible(monkeypatch: pytest.MonkeyPatch) -> None:
    """All these files have a fixed place, so no hint recommends another one."""

    def refused(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch, pytest.raises(DoraSystemdError) as caught:
        patch.setattr(os, "open", refused)
        write_atomic(Path("/etc/systemd/system/dora-robot.service"), "text")
    assert caught.value.hint == "use sudo, or --user for a dataflow of your own"
    assert caught.value.code is ExitCode.NO_PERMISSION
