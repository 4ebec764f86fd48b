"""Names, units and UUIDs: what is allowed, and that nothing allowed is another unit."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import (
    is_uuid_prefix,
    name_from_path,
    name_from_unit,
    parse_name,
    parse_uuid,
    unit_name,
)

UUID = "550e8400-e29b-41d4-a716-446655440000"
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,30}", fullmatch=True).filter(
    lambda name: name != "gateway" and "." not in name and not name.endswith("-")
)


@pytest.mark.parametrize("name", ["robot", "a", "0", "Robot_2.front-left", "x" * 186, "service"])
def test_names(name: str) -> None:
    assert parse_name(name) == name
    assert name_from_unit(unit_name(name)) == name


@pytest.mark.parametrize(
    "name",
    [
        *("", "a/b", "../x", "-x", ".", "..", "x.service", "x.slice", "x.target", "a b", "a\n"),
        *("x" * 187, "röbot", "a@b", "a:b", "gateway", "a\0b", "%i", "$HOME", "٣", "a-", "a.-"),
    ],
)
def test_bad_names(name: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot use .* as a name$") as caught:
        parse_name(name)
    assert caught.value.code == ExitCode.USAGE
    assert caught.value.hint
    assert name_from_unit(unit_name(name)) is None


@given(st.text())
def test_any_text_is_a_name_or_refused(text: str) -> None:
    try:
        unit = unit_name(parse_name(text))
    except DoraSystemdError:
        return
    assert len(unit) < 256
    assert not unit.endswith("-.service")  # its drop-ins would be those of others, too
    assert unit.isascii()
    assert not set(unit) & set("/@ %$\\\n")


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/srv/robot.yml", "robot"),
        ("robot.front.yaml", "robot.front"),
        ("/srv/my robot!.yml", "my-robot"),
        ("/srv/-x.yml", "x"),
        ("röbot.yml", "r-bot"),
        (".hidden.yml", "hidden"),
        ("/srv/robot/dataflow.yml", "robot"),
        ("dataflow.yml", "dataflow"),
        ("/dataflow.yml", "dataflow"),
        ("x" * 300 + ".yml", "x" * 186),
    ],
)
def test_names_from_paths(path: str, name: str) -> None:
    assert name_from_path(path) == name


@pytest.mark.parametrize("path", ["", "/", "/srv/---.yml", "gateway.yml", "x.service.yml", "ü.yml"])
def test_paths_without_a_name(path: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot make a name from") as caught:
        name_from_path(path)
    assert "--name" in caught.value.hint


@given(st.text())
def test_names_from_any_path_are_names(path: str) -> None:
    try:
        name = name_from_path(path)
    except DoraSystemdError:
        return
    assert parse_name(name) == name


@pytest.mark.parametrize("unit", ["", "x.service", "dora-x.slice", "dora-gateway.service", "dora-"])
def test_other_units(unit: str) -> None:
    assert name_from_unit(unit) is None


@given(names)
def test_unit_and_back(name: str) -> None:
    assert name_from_unit(unit_name(name)) == name


@given(st.uuids())
def test_uuids_and_their_prefixes(uuid: object) -> None:
    text = str(uuid)
    assert parse_uuid(text.upper()) == text
    assert all(is_uuid_prefix(text[:length]) for length in range(4, 37))


@pytest.mark.parametrize("text", ["", UUID[:-1], UUID + "0", UUID.replace("-", ""), "x" * 36])
def test_bad_uuids(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="as a UUID"):
        parse_uuid(text)


@pytest.mark.parametrize("text", ["", "550", "550e84000", "550e8400_", "robot", UUID + "0", "٣٣٣٣"])
def test_no_prefixes(text: str) -> None:
    assert not is_uuid_prefix(text)
