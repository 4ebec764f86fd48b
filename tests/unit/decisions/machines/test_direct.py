"""`link: direct`: which addresses it takes, and what the units of the machines are told."""

from collections.abc import Mapping
from typing import Any

import pytest

from dora_systemd.decisions.cell.options import RunnerOptions, format_runner_argv, parse_runner_argv
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.machines.address import endpoint, parse_address
from dora_systemd.decisions.machines.link_command import LinkOptions, ssh_link_arguments
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.spread import spread
from dora_systemd.decisions.machines.wire import Forwards
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.properties import (
    UnitContext,
    address_properties,
    format_unit,
    unit_properties,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

FILE = "/srv/robot/dataflow.yml"
BESIDE = "/srv/robot/dataflow.systemd.yml"
UUID = "7d1ab6b8-9c14-4f53-8f6c-3a3ea1a2f0a1"
NETWORKS = {"10.99.0.": "10.99.0.1", "10.98.0.": "10.98.0.1", "fd00:99::": "fd00:99::1"}
GPU = {"host": "gpu-box", "link": "direct", "address": "10.99.0.2"}
PI = {"host": "pi", "link": "direct", "address": "10.99.0.3"}


def route(address: str, wanted: str) -> str:
    """That of a machine with these networks."""
    own = next((own for start, own in NETWORKS.items() if address.startswith(start)), "")
    return wanted if wanted in NETWORKS.values() else own if not wanted else ""


def flow() -> Dataflow:
    nodes = [
        {"id": "camera", "path": "a.py"},
        {"id": "yolo", "path": "b.py", "deploy": {"machine": "gpu"}},
        {"id": "arm", "path": "c.py", "deploy": {"machine": "pi"}},
    ]
    return parse_dataflow({"nodes": nodes}, FILE)


def spread_out(
    gpu: Mapping[str, Any] = GPU, pi: Mapping[str, Any] = PI, **flags: object
) -> tuple[RunnerOptions, tuple[Member, ...]]:
    document = {"machines": {"gpu": dict(gpu), "pi": dict(pi)}}
    settings = resolve_settings(flags, {}, [(BESIDE, document)])
    options = RunnerOptions("robot", UUID, FILE, "/srv/robot", "/usr/bin/dora")
    return spread(flow(), options, settings, {}, "robot-1", route)


def refusal(*given: Mapping[str, Any]) -> DoraSystemdError:
    with pytest.raises(DoraSystemdError) as caught:
        spread_out(*given)
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.hint
    return caught.value


def addresses_of(words: tuple[str, ...]) -> list[str]:
    return [one.partition("=")[2] for one in words if one.startswith("--address=")]


def test_each_machine_hears_its_own_address_first() -> None:
    options, members = spread_out()
    assert options.addresses == ("10.99.0.1", "10.99.0.2", "10.99.0.3")
    assert parse_runner_argv(format_runner_argv(options)) == options
    assert [addresses_of(one.words) for one in members] == [
        ["10.99.0.2", "10.99.0.1", "10.99.0.3"],
        ["10.99.0.3", "10.99.0.1", "10.99.0.2"],
    ]


def test_ssh_is_told_nothing_of_addresses() -> None:
    options, members = spread_out({"host": "gpu-box"}, {"host": "pi"})
    assert options.addresses == ()
    assert not any(addresses_of(one.words) for one in members)


def test_the_address_of_the_head_can_be_given() -> None:
    gpu, pi = ({**one, "head_address": "10.98.0.1"} for one in (GPU, PI))
    options, _ = spread_out(gpu, pi)
    assert options.addresses[0] == "10.98.0.1"


@pytest.mark.parametrize(
    ("gpu", "text"),
    [
        ({"host": "gpu-box"}, "the link of machine pi is direct, that of gpu is not"),
        ({**GPU, "address": "10.99.0.3"}, "gpu and pi have the same address 10.99.0.3"),
        ({**GPU, "address": "10.99.0.1"}, "head and gpu have the same address 10.99.0.1"),
        ({**GPU, "address": "10.98.0.2"}, "gpu from 10.98.0.1, and pi from 10.99.0.1"),
        ({**GPU, "address": "fd00:99::2"}, "gpu from fd00:99::1, and pi from 10.99.0.1"),
        ({**GPU, "address": "10.1.0.2"}, "the head cannot reach address 10.1.0.2 of machine gpu"),
        ({**GPU, "head_address": "10.9.9.9"}, "of machine gpu from 10.9.9.9"),
        ({"link": "direct"}, f"machines.gpu in {BESIDE}: link: direct needs an address"),
        ({"address": "10.99.0.2"}, "address is for link: direct only"),
        ({"head_address": "10.99.0.2"}, "head_address is for link: direct only"),
        ({**GPU, "address": None}, "link: direct needs an address"),
        ({**GPU, "address": True}, f"address of machines.gpu in {BESIDE}: cannot use"),
        ({**GPU, "address": ["10.99.0.2"]}, "the value of address is of another type"),
        ({**GPU, "head_address": "0.0.0.0"}, "head_address of machines.gpu"),
    ],
)
def test_machines_that_cannot_meet(gpu: dict[str, Any], text: str) -> None:
    assert text in refusal(gpu).message


@pytest.mark.parametrize(
    "text",
    [
        *("", "gpu-box", "10.0.0", "10.0.0.1/24", "10.0.0.1 ", "010.0.0.1", "1", "10.0.0.1:80"),
        *("0.0.0.0", "127.0.0.1", "127.9.9.9", "224.0.0.1", "169.254.1.1", "255.255.255.255"),
        *("::", "::1", "ff02::1", "fe80::1", "fe80::1%lan", "fd00::1%lan", "::ffff:127.0.0.1"),
        *("::ffff:10.0.0.1", "[fd00::1]", "10.0.0.1\n", "١٠.٠.٠.١"),
    ],
)
def test_addresses_that_no_machine_listens_on(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_address(text)
    assert caught.value.code is ExitCode.USAGE
    assert "\n" not in caught.value.message


def test_addresses_as_dora_takes_them() -> None:
    assert endpoint(parse_address("10.99.0.2"), 61000) == "10.99.0.2:61000"
    assert endpoint(parse_address("FD00:0::2"), 61000) == "[fd00::2]:61000"


def test_a_unit_exchanges_packets_with_these_machines_only() -> None:
    options, _ = spread_out()
    flags = {"property": ("IPAddressAllow=192.0.2.0/24",), "needs": ("network",)}
    settings = resolve_settings(flags, {}, [])
    unit = unit_properties(options, UnitContext("/usr/bin/python3", is_user=False), settings)
    lines = format_unit(unit).splitlines()
    assert [one for one in lines if one.startswith("IPAddress")] == [
        "IPAddressDeny=0.0.0.0/0 ::/0",
        "IPAddressAllow=127.0.0.0/8 ::1/128 10.99.0.1/32 10.99.0.2/32 10.99.0.3/32 192.0.2.0/24",
    ]
    assert "network-online.target" in next(one for one in lines if one.startswith("After="))
    assert address_properties(options.addresses, is_user=True) == {}
    assert address_properties((), is_user=False) == {}


def test_ssh_forwards_the_coordinator_only() -> None:
    link = LinkOptions("/run/x/runner.sock", "gpu", "gpu-box", ("member", FILE))
    words = ssh_link_arguments(link, Forwards(61001, {}), "mark")
    assert [one for one in words if one.startswith(("-R", "-L"))] == [
        "-R127.0.0.1:61001:127.0.0.1:61001"
    ]
