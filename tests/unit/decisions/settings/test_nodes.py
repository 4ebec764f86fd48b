"""Settings of single nodes on the command line."""

from pathlib import PurePath
from typing import Any

import pytest

from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.settings.resolve import given_texts, resolve_settings
from dora_systemd.decisions.settings.table import CHANGEABLE, NODES
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import SECOND, cpu_bits

FILE = "/srv/robot.systemd.yml"


def given(*texts: str, **document: Any) -> Any:
    return resolve_settings({"nodes": texts}, {}, [(FILE, {"nodes": document})]).nodes


def refused(*texts: str, **more: Any) -> DoraSystemdError:
    with pytest.raises(DoraSystemdError) as caught:
        resolve_settings({"nodes": texts}, {}, (), **more)
    assert caught.value.code is ExitCode.USAGE
    return caught.value


def test_a_comma_without_a_key_after_it_is_part_of_the_value() -> None:
    assert given("a:cpus=0,2-3,nice=5,watch=*.py,*.toml") == {
        "a": {"cpus": cpu_bits([0, 2, 3]), "nice": 5, "watch": ("*.py", "*.toml")}
    }
    found = given("a:stop=within=60s,after=b,owes=image:within=2s,then=warn,essential=yes")["a"]
    assert found["stop"] == NodeStop("", 60 * SECOND, ("b",))
    assert [(one.output, one.within, one.then) for one in found["owes"]] == [
        ("image", 2 * SECOND, "warn")
    ]
    assert found["essential"] is True


def test_a_list_grows_and_of_other_values_the_last_one_counts() -> None:
    texts = ("a:needs=/dev/x,needs=net:can0,nice=1", "b:nice=2", "a:nice=3,needs=/dev/y")
    assert given(*texts) == {
        "a": {"needs": ("/dev/x", "net:can0", "/dev/y"), "nice": 3},
        "b": {"nice": 2},
    }


def test_a_flag_replaces_what_files_have_for_the_node_and_the_key() -> None:
    beside = {"a": {"needs": ["/dev/x", "/dev/y"], "nice": 1}, "c": {"nice": 2}, "d": None}
    assert given("a:needs=/dev/z", **beside) == {
        "a": {"needs": ("/dev/z",), "nice": 1},
        "c": {"nice": 2},
    }


def test_what_a_deploy_records() -> None:
    texts = ("a:cpu_limit=1.5,owes=image:within=2s",)
    recorded = given_texts({"nodes": texts}, {}, PurePath("/srv"))["nodes"]
    assert recorded == ["a:cpu_limit=150%", "a:owes=image:within=2s,first=30s,then=restart"]
    assert given(*recorded) == given(*texts)
    twice = ["ExecStartPre=/bin/a", "ExecStartPre=/bin/a"]
    assert given_texts({"property": twice}, {}, PurePath("/srv"))["property"] == twice


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("a", "'a' as settings of a node", "write NODE:KEY=VALUE"),
        ("a:essential", "'essential' as a setting of the node 'a'", "write essential=VALUE"),
        ("a:memory_limi=1G", "'memory_limi=1G' as a setting of the node 'a'", "memory_limit"),
        ("a:sandbox=none", "'sandbox=none' as a setting of the node 'a'", "dora-systemd.yml(5)"),
        ("a:owes=image:within=2s,thn=warn", "'thn=warn' as a setting", "did you mean then"),
        ("a:nice=1,", "'1,' as nice value", "from -20"),
        ("a:needs=unit:x.service", "a node needs paths", "--needs unit:x.service"),
    ],
)
def test_an_error_names_the_node_and_the_key(text: str, message: str, hint: str) -> None:
    error = refused(text)
    assert message in error.message
    assert "(--node" in error.message
    assert hint in error.hint


def test_a_bad_value_names_its_place() -> None:
    assert refused("a:nice=99").message == "cannot use '99' as nice value (--node a:nice)"


def test_a_running_dataflow_takes_few_keys() -> None:
    error = refused("a:nice=5", table=CHANGEABLE)
    assert error.hint.startswith("valid keys: cpu_limit, memory_limit, ")
    assert NODES.name in {one.name for one in CHANGEABLE}
