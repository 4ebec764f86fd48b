"""Who may ask the gateway."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.gateway.request import (
    MAX_CONNECTIONS,
    MAX_OF_STRANGER,
    MAX_STRANGERS,
    Door,
    has_token,
    refuse_address,
    refuse_user,
)

TOKEN = "3f" * 32
ME, OTHER = 1000, 1001


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:53290", "localhost:53290", "LOCALHOST", "[::1]:53290", "127.0.0.1", "localhost:80"],
)
def test_own_names(host: str) -> None:
    assert refuse_address([host]) is None
    assert refuse_address([host], [f"http://{host.lower()}"]) is None


@pytest.mark.parametrize(
    "hosts",
    [
        [],
        [""],
        ["evil.example:53290"],
        ["127.0.0.1.evil.example"],
        ["localhost.evil.example:53290"],
        ["evil.example", "localhost"],
        ["localhost", "localhost"],
        ["192.168.1.5:53290"],
        ["127.0.0.1:53290\n"],
        ["127.0.0.1:٣"],
        ["user@localhost"],
        ["127.0.0.2:53290"],
        ["0.0.0.0:53290"],
    ],
)
def test_other_names(hosts: list[str]) -> None:
    refusal = refuse_address(hosts)
    assert refusal is not None
    assert refusal.status == 403


@pytest.mark.parametrize(
    "origins",
    [
        ["https://evil.example"],
        ["null"],
        [""],
        ["http://localhost:8080"],
        ["https://localhost:53290"],
        ["http://127.0.0.1:53290"],
        ["http://localhost:53290/"],
        ["http://localhost:53290", "https://evil.example"],
    ],
)
def test_other_origins(origins: list[str]) -> None:
    refusal = refuse_address(["localhost:53290"], origins)
    assert refusal is not None
    assert refusal.status == 403


@pytest.mark.parametrize(
    ("uid", "authorization", "is_let_in"),
    [
        (ME, "", True),
        (0, "", True),
        (OTHER, "", False),
        (None, "", False),
        (OTHER, f"Bearer {TOKEN}", True),
        (None, f"bearer  {TOKEN} ", True),
        (OTHER, TOKEN, False),
        (OTHER, f"Bearer {TOKEN[:-1]}", False),
        (OTHER, f"Bearer {TOKEN}0", False),
        (OTHER, "Bearer ", False),
        (OTHER, f"Basic {TOKEN}", False),
        (OTHER, "Bearer \udcff", False),
        # Somebody with a wrong token is still who he is.
        (ME, "Bearer wrong", True),
    ],
)
def test_users(uid: int | None, authorization: str, is_let_in: bool) -> None:
    refusal = refuse_user(uid, ME)
    has_right = has_token([authorization] if authorization else [], TOKEN)
    assert (refusal is None or has_right) == is_let_in
    assert refusal is None or refusal.status == 401


@given(st.text())
def test_nothing_else_is_a_token(text: str) -> None:
    assert not has_token([text], TOKEN)
    assert not has_token([f"Bearer {text}"], "")


def test_two_tokens_are_none() -> None:
    right = f"Bearer {TOKEN}"
    assert not has_token([right, right], TOKEN)


def test_whatever_others_do_root_and_the_owner_get_in() -> None:
    door = Door(ME)
    strangers = [*([OTHER] * 400), *([None] * 100), *range(2000, 2100)]
    inside = [uid for uid in strangers if door.enter(uid)]
    assert len(inside) == MAX_STRANGERS
    assert inside.count(OTHER) == MAX_OF_STRANGER
    assert all(door.enter(uid) for uid in [0, ME] * (MAX_CONNECTIONS // 2))
    assert not door.enter(0)
    for uid in (OTHER, ME):
        door.leave(uid)
        assert door.enter(uid)
        assert not door.enter(uid)


def test_who_is_a_stranger() -> None:
    assert [uid for uid in (0, ME, OTHER, None) if Door(ME).is_stranger(uid)] == [OTHER, None]
    assert Door(0).is_stranger(ME)
