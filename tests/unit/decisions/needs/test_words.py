"""The words of `needs`: what is accepted, in which form it is kept, and what is refused."""

import pytest

from dora_systemd.decisions.cell.options import format_runner_argv, parse_runner_argv
from dora_systemd.decisions.needs.units import needs_properties
from dora_systemd.decisions.needs.words import (
    NodeNeed,
    check_needs,
    needs_of,
    parse_needs,
    parse_node_needs,
)
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.errors import DoraSystemdError
from tests.unit.fakes.manager import options as runner_options


def test_each_need_is_kept_once_and_in_its_shortest_form() -> None:
    texts = ["network", " clock ", "network", "dataflow:base", "unit:a@b.service", "mount:/mnt//x/"]
    assert parse_needs(texts) == (
        *("network", "clock", "dataflow:base", "unit:a@b.service", "mount:/mnt/x"),
    )
    assert parse_node_needs(["/dev//video0", "/dev/./video0"]) == ("/dev/video0",)


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "net",
            "net:",
            "dataflow:",
            "dataflow:a/b",
            "unit:nginx",
            "unit:../x.service",
            "unit:a b.mount",
        ),
        *(
            "mount:mnt",
            "mount:/",
            "mount:/a/../b",
            "mount:/50%",
            "dev/video0",
            "camera=dev",
            "/",
            "//",
        ),
        *("/dev/\x1b[2J", "a b=/x", "=/x", "/dev/../etc", "clock=/x\n", "unit:x.service\nAfter=y"),
    ],
)
def test_other_words_are_refused_in_one_line(text: str) -> None:
    for parse in (parse_needs, parse_node_needs):
        with pytest.raises(DoraSystemdError) as caught:
            parse([text])
        assert "\n" not in caught.value.message + caught.value.hint
        assert caught.value.hint


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "a/b", "a:b", "can%d", "can 0", "can0\x07", "can0\n", "cän0"),
        *("sixteen-letters0", "x" * 4096),
    ],
)
def test_an_interface_that_cannot_be_is_refused(name: str) -> None:
    if name == "can0\n":  # the end of a line is no part of a need
        assert parse_node_needs([f"net:{name}"]) == ("net:can0",)
        return
    with pytest.raises(DoraSystemdError) as caught:
        parse_node_needs([f"net:{name}"])
    assert "\n" not in caught.value.message
    assert "net:can0" in caught.value.hint


def test_an_interface_is_kept_as_the_kernel_names_it() -> None:
    texts = ("net:fifteen-letters", "net:a=b", "net:enp3s0.7@", "net:7", "/dev/a=/b")
    assert parse_node_needs(texts) == texts


def test_a_dataflow_needs_no_interface() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_needs(("net:can0",))
    assert caught.value.message.endswith("a network interface is what a node needs")
    assert "nodes: NODE: needs: net:can0" in caught.value.hint


def test_a_word_that_is_nearly_right_gets_a_hint() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_needs(["netwrok"])
    assert caught.value.hint == "did you mean network?"


def test_paths_are_for_nodes_and_units_for_the_dataflow() -> None:
    with pytest.raises(DoraSystemdError, match="a path is what a node needs"):
        parse_needs(("network", "/dev/video0"))
    for text in ("network", "unit:x.service"):
        with pytest.raises(DoraSystemdError, match="a node needs paths and net:INTERFACE"):
            parse_node_needs(("/dev/video0", text))


def test_the_need_of_a_node_survives_the_command_line() -> None:
    file = "/srv/robot.systemd.yml"
    flags = {"nodes": ("arm:needs=/dev/a",), "needs": ("network",)}
    document = {"nodes": {"camera.left": {"needs": ["/dev/v4l/by-id/a=b", "net:can0"]}}}
    settings = resolve_settings(flags, {}, [(file, document)])
    argv = format_runner_argv(with_settings(runner_options(), settings))
    assert needs_of(parse_runner_argv(argv)) == (
        NodeNeed("camera.left", "/dev/v4l/by-id/a=b"),
        NodeNeed("camera.left", "net:can0"),
        NodeNeed("arm", "/dev/a"),
    )


def test_a_node_that_dora_starts_itself_cannot_wait() -> None:
    need = [NodeNeed("camera", "/dev/video0")]
    check_needs(need, {"camera"})
    with pytest.raises(DoraSystemdError, match="node camera cannot wait for /dev/video0"):
        check_needs(need, {"other"})


def test_needs_become_dependencies_of_the_unit() -> None:
    needs = ("network", "clock", "dataflow:base", "unit:x.service", "mount:/mnt/a b")
    found = {key: one.value for key, one in needs_properties(needs, "chrony-wait.service").items()}
    wanted = ("network-online.target", "time-sync.target", "chrony-wait.service")
    assert found["Wants"] == wanted
    assert set(found["Requires"]) == {"x.service", "dora-base.service"}
    assert set(found["After"]) == {*wanted, *found["Requires"]}
    assert found["RequiresMountsFor"] == ("/mnt/a b",)
    assert needs_properties((), "chrony-wait.service") == {}


def test_the_escapes_of_a_unit_stay() -> None:
    unit = r"dev-disk-by\x2duuid-1.device"
    found = needs_properties((f"unit:{unit}",), "")
    assert (found["Requires"].value, found["After"].value) == ((unit,), (unit,))
