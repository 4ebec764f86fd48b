import pytest

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.machines.link_command import (
    LinkOptions,
    check_forwards,
    link_command,
    member_words,
    parse_link_argv,
    parse_link_command,
    ssh_link_arguments,
)
from dora_systemd.decisions.machines.link_unit import (
    link_unit,
    link_unit_name,
    link_units_of,
    wanted_links,
)
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.wire import Forwards
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.manager import UUID, options

SOCKET = "/run/dora-systemd/robot/runner.sock"
WORDS = ("member", "/srv/it's $5/robot.yml", "--name=robot", "--placed=yolo=gpu")
LINK = LinkOptions(SOCKET, "gpu", "alice@gpu-box:2222", WORDS)
FORWARDS = Forwards(61001, {"head": 61002, "gpu": 61003, "arm": 61004})
OLD = UUID.replace("5", "6")
PLACED = (Placed("yolo", "gpu"), Placed("arm", "arm"), Placed("depth", "gpu"))


def test_the_command_line_of_a_link() -> None:
    command = link_command("/usr/bin/python3", LINK)
    assert command[:3] == ["/usr/bin/python3", "-I", "-S"]
    assert parse_link_argv(command[4:]) == parse_link_command(command) == LINK


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["member"],
        [f"--socket={SOCKET}", "--machine=gpu", "--host=b", "--identity="],
        ["--socket=here", "--machine=gpu", "--host=b", "--identity=", "member"],
        [f"--socket={SOCKET}", "--host=b", "--machine=gpu", "--identity=", "member"],
    ],
)
def test_no_command_line_of_a_link(argv: list[str]) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_link_argv(argv)
    assert caught.value.code is ExitCode.USAGE


def test_the_member_hears_its_own_name_first() -> None:
    assert member_words(LINK) == ["member", "--as=gpu", *WORDS[1:]]
    with_key = member_words(LINK._replace(identity="/etc/key"))
    assert with_key == ["member", "--restricted", "--as=gpu", *WORDS[1:]]


def test_ports_are_the_same_on_both_machines() -> None:
    arguments = ssh_link_arguments(LINK, FORWARDS, "mark")
    remote = [one for one in arguments if one.startswith("-R")]
    local = [one for one in arguments if one.startswith("-L")]
    same = "127.0.0.1:{0}:127.0.0.1:{0}"
    assert remote == [f"-R{same.format(port)}" for port in (61001, 61002, 61004)]
    assert local == [f"-L{same.format(61003)}"]
    assert "-p2222" in arguments
    assert arguments[-3:-1] == ["--", "alice@gpu-box"]
    assert "-oBatchMode=yes" in arguments
    assert "'/srv/it'\\''s $5/robot.yml'" in arguments[-1]
    with_key = ssh_link_arguments(LINK._replace(identity="/etc/key"), FORWARDS, "mark")
    assert "-i/etc/key" in with_key


@pytest.mark.parametrize(
    "forwards",
    [
        Forwards(6379, {"head": 61002, "gpu": 61003}),
        Forwards(61001, {"head": 61002, "gpu": 5432}),
        Forwards(61001, {"head": 61001, "gpu": 61003}),
        Forwards(61001, {"gpu": 61003}),
        Forwards(61001, {"head": 61002, "arm": 61003}),
        Forwards(61001, {"head": 61002, **{f"m{n}": 61003 + n for n in range(70)}, "gpu": 62000}),
    ],
)
def test_no_port_of_a_usual_service_is_forwarded(forwards: Forwards) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        check_forwards(forwards, "gpu")
    assert caught.value.code is ExitCode.BAD_INPUT


def test_two_links_never_share_a_unit() -> None:
    pairs = [("a-b", "c"), ("a", "b-c"), ("a", "b.c"), ("a.b", "c"), ("a_b", "c")]
    assert len({link_unit_name(*pair) for pair in pairs}) == len(pairs)
    with pytest.raises(DoraSystemdError):
        link_unit_name("a" * 200, "b" * 100)


def test_the_head_starts_its_links() -> None:
    head = options(placed=PLACED)
    units = ["doralink-robot:gpu.service", "doralink-robot:arm.service"]
    assert link_units_of(head) == units
    assert wanted_links(head)["Wants"].value == tuple(units)
    assert wanted_links(options()) == {}
    assert link_units_of(options(placed=PLACED, machine="gpu")) == []


@pytest.mark.parametrize("is_user", [True, False])
def test_a_link_lives_as_long_as_the_unit_of_the_head(is_user: bool) -> None:
    member = Member("gpu", parse_host("alice@gpu-box"), WORDS)
    found = link_unit("/usr/bin/python3", SOCKET, options(placed=PLACED), member, is_user)
    text = format_unit(found.properties)
    assert found.unit == "doralink-robot:gpu.service"
    for line in (
        *("StopWhenUnneeded=yes", "Restart=always", "Before=dora-robot.service"),
        *("WatchdogSec=25s", "WatchdogSignal=SIGKILL"),
    ):
        assert line in text
    assert "StartLimitIntervalSec=0" in text
    assert ("ProtectSystem=strict" in text) is not is_user
    assert "token" not in text


def test_a_member_hears_the_uuid_that_is_known() -> None:
    member = Member("gpu", parse_host("b"), (*WORDS, f"--uuid={OLD}", f"--env=A=--uuid={OLD}"))
    assert member.with_uuid(OLD, UUID).words == (*WORDS, f"--uuid={UUID}", f"--env=A=--uuid={OLD}")
