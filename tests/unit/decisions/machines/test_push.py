"""`start --push`: what is copied where, and what the other machine says."""

import pytest

from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.push import (
    check_copied,
    check_place,
    format_place,
    place_words,
    rsync_command,
)
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.errors import DoraSystemdError, ExitCode

FILE = "/srv/my robot/flow.yml"


def member(host: str = "alice@gpu-box", file: str = "/home/alice/robot/flow.yml") -> Member:
    return Member("gpu", parse_host(host), ("member", file, "--name=robot"))


def test_the_directory_of_the_file_is_copied() -> None:
    words = rsync_command(member(), FILE)
    assert words[0] == "rsync"
    assert words[-3:] == ["--", "/srv/my robot/", "alice@gpu-box:/home/alice/robot/"]
    assert "--exclude=.git/" in words
    assert "--exclude=/flow.systemd.yml" in words, "the settings are those of the head"
    assert not {"--delete", "--owner", "--archive", "--devices"} & {*words}
    assert place_words(member()) == ("member", "--place=/home/alice/robot")


@pytest.mark.parametrize(
    ("host", "target", "port"),
    [
        ("gpu-box:2222", "gpu-box:", " -p2222"),
        ("alice@fd00::2", "alice@[fd00::2]:", ""),
        ("[fd00::2]:2222", "[fd00::2]:", " -p2222"),
    ],
)
def test_hosts_as_rsync_takes_them(host: str, target: str, port: str) -> None:
    words = rsync_command(member(host), FILE)
    assert words[-1] == f"{target}/home/alice/robot/"
    (shell,) = (one for one in words if one.startswith("--rsh="))
    assert shell.endswith(port) or not port
    assert "-oBatchMode=yes" in shell


def test_what_the_machine_says_of_its_directory() -> None:
    check_place(member(), format_place("", ""))
    with pytest.raises(DoraSystemdError) as caught:
        check_place(member(), format_place("/srv/x belongs to bob", "ask bob"))
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.message == (
        "cannot copy the dataflow to machine gpu: /srv/x belongs to bob"
    )
    assert caught.value.hint == "ask bob"


@pytest.mark.parametrize("answer", ["", "{}", "[]", '{"problem": 1}', "[" * 100_000])
def test_an_answer_of_something_else(answer: str) -> None:
    with pytest.raises(DoraSystemdError, match="its answer cannot be read"):
        check_place(member(), answer)


def test_why_rsync_has_failed() -> None:
    check_copied(member(), 0, "")
    said = "rsync: [Receiver] mkdir failed: Permission denied (13)\nrsync error: some files (23)\n"
    with pytest.raises(DoraSystemdError, match="mkdir failed: Permission denied"):
        check_copied(member(), 11, said)
    with pytest.raises(DoraSystemdError, match="exit status 12"):
        check_copied(member(), 12, "")
    with pytest.raises(DoraSystemdError) as caught:
        check_copied(member(), 255, "ssh: connect to host gpu-box port 22: Connection refused\n")
    assert caught.value.code is ExitCode.NO_HOST
