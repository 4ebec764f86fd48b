"""What -H names, and how it is taken out of a command line."""

import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.remote.command_line import part_hosts, with_output, without_flag
from dora_systemd.decisions.remote.hosts import (
    Host,
    Way,
    given_words,
    parse_host,
    parse_hosts_file,
    quote,
    remote_command,
    ssh_arguments,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

VALUED = {"logs": {"-n", "--lines", "-g", "--grep"}, "stop": {"--name"}}


def parted(line: str) -> tuple[str, str]:
    found = part_hosts(line.split(), lambda verb: VALUED.get(verb, set()))
    return ",".join(found.hosts), " ".join(found.words)


@pytest.mark.parametrize(
    ("line", "hosts", "words"),
    [
        ("list", "", "list"),
        ("-H a list", "a", "list"),
        ("list -H a,b -o json", "a,b", "list -o json"),
        ("list -Ha", "a", "list"),
        ("list -aHb x", "b", "list -a x"),
        ("--host=a --user list --host b", "a,b", "--user list"),
        ("logs -g -H x", "", "logs -g -H x"),
        ("logs -fg -H x", "", "logs -fg -H x"),
        ("logs -gx -H a", "a", "logs -gx"),
        ("logs --grep -H x", "", "logs --grep -H x"),
        ("logs --grep=x -H a", "a", "logs --grep=x"),
        ("logs -g x -H a", "a", "logs -g x"),
        ("dora robot -- -H x", "", "dora robot -- -H x"),
        ("dora -H a robot -- -H x", "a", "dora robot -- -H x"),
        ("stop - -H a", "a", "stop -"),
        ("list -n -H a", "a", "list -n"),
        ("logs -n", "", "logs -n"),
    ],
)
def test_hosts_are_taken_out(line: str, hosts: str, words: str) -> None:
    assert parted(line) == (hosts, words)


@pytest.mark.parametrize("line", ["list -H", "list --host", "-H"])
def test_an_option_without_a_host(line: str) -> None:
    with pytest.raises(DoraSystemdError, match="requires a host"):
        parted(line)


@pytest.mark.parametrize(
    ("text", "destination", "port"),
    [
        ("robot", "robot", ""),
        ("alice@robot.example.org", "alice@robot.example.org", ""),
        ("alice@robot:2222", "alice@robot", "2222"),
        ("10.0.0.1:22", "10.0.0.1", "22"),
        ("fe80::1%eth0", "fe80::1%eth0", ""),
        ("[::1]:2222", "::1", "2222"),
        ("root@[fe80::1%eth0]", "root@fe80::1%eth0", ""),
        ("::1", "::1", ""),
    ],
)
def test_a_host(text: str, destination: str, port: str) -> None:
    assert parse_host(text) == Host(text, destination, port)


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "-oProxyCommand=x",
            "a@-x",
            "-x@a",
            "a b",
            "a;b",
            "a:0",
            "a:99999",
            "@a",
            "a@",
            "a/b",
        ),
        *("$(x)", "a\n", "a:", "[a]", "x" * 300, "ä", "a@b@c"),
    ],
)
def test_what_is_no_host(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"cannot use .* as a host") as caught:
        parse_host(text)
    assert caught.value.code is ExitCode.USAGE


def test_several_hosts() -> None:
    assert given_words(["a,b", "c, a"]) == ["a", "b", "c"]
    for text in ("a,", ",", ""):
        with pytest.raises(DoraSystemdError):
            given_words([text])


def test_a_hosts_file() -> None:
    text = "# robots\nbase\n\n  alice@arm:2222 # left\nbase\n"
    assert [host.text for host in parse_hosts_file(text, "hosts")] == ["base", "alice@arm:2222"]
    for line in ("-oX", "all", "a,b", "a b"):
        with pytest.raises(DoraSystemdError, match="cannot read hosts: line 2: ") as caught:
            parse_hosts_file(f"base\n{line}\n", "hosts")
        assert caught.value.code is ExitCode.BAD_INPUT


@given(st.lists(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))))
def test_every_word_arrives(words: list[str]) -> None:
    command = ["sh", "-c", f"printf '%s\\0' {' '.join(map(quote, words))}"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert done.stdout.decode().split("\0")[:-1] == (words or [""])


def test_no_word_has_a_backslash_within_quotes() -> None:
    """fish takes one for an escape there, and sh does not."""
    assert quote(r"a\b'c") == r"'a'\\'b'\''c'"


def test_the_command_of_ssh() -> None:
    command = remote_command(Way.ONCE, ["list", "-o", "json"], "mark")
    words = ssh_arguments(Host("a@b:7", "a@b", "7"), Way.ONCE, command)
    assert words[-3:] == ["--", "a@b", command]
    assert words[words.index("-p") + 1] == "7"
    assert "BatchMode=yes" in words
    assert "BatchMode=yes" not in ssh_arguments(Host("b", "b"), Way.TERMINAL, command)


@pytest.mark.parametrize("way", [Way.TERMINAL, Way.ONCE, Way.FED])
def test_a_host_knows_how_it_was_called(way: Way, tmp_path: Path) -> None:
    program = tmp_path / "doractl"
    program.write_text('#!/bin/sh\necho "as $DORACTL_REACHED_AS: $*"\n')
    program.chmod(0o755)
    command = remote_command(way, ["list"], "mark", Host("a@b:7", "a@b", "7"))
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
    done = subprocess.run(
        ["sh", "-c", command], check=True, capture_output=True, env=environment, input=b""
    )
    assert b"as a@b:7: list\n" in done.stdout


@pytest.mark.parametrize(
    ("line", "expected"),
    [("list", "list -o json"), ("list -- x", "list -o json -- x"), ("list x", "list x -o json")],
)
def test_another_output(line: str, expected: str) -> None:
    assert " ".join(with_output(line.split(), "json")) == expected


@pytest.mark.parametrize(
    ("line", "rest"),
    [
        ("deploy -q", "deploy"),
        ("deploy . -o json --quiet --name q", "deploy . -o json --name q"),
        ("deploy -qo json", "deploy -o json"),
        ("deploy -xqy", "deploy -xy"),
        ("deploy -oq", "deploy -oq"),
        ("deploy -o -q", "deploy -o -q"),
        ("deploy --name --quiet -q", "deploy --name --quiet"),
        ("deploy -- -q", "deploy -- -q"),
        ("deploy - -q -o", "deploy - -o"),
    ],
)
def test_a_flag_is_left_out(line: str, rest: str) -> None:
    assert " ".join(without_flag(line.split(), "-q", "--quiet", {"-o", "--name"})) == rest
