"""What the head hears when a connection has ended."""

import pytest

from dora_systemd.decisions.machines.wire import Lost, Refused
from dora_systemd.link.parting import last_word

OF_DORACTL = "doractl: it has no address 10.99.0.2\nhint: see machines in dora-systemd.yml(5)\n"


@pytest.mark.parametrize(
    ("status", "is_in", "said", "complaint", "words"),
    [
        (1, True, "", OF_DORACTL, "it has no address 10.99.0.2"),
        (255, True, "", "client_loop: send disconnect: Broken pipe\n", "client_loop: send"),
        (255, False, "", "ssh: connect to host b port 22: No route to host\n", "connect to host b"),
        (1, False, "This account is not available.\n", "", "This account is not available."),
        (0, True, "", "", "it has ended"),
        (1, True, "", "", "exit status 1"),
    ],
)
def test_what_may_pass(status: int, is_in: bool, said: str, complaint: str, words: str) -> None:
    found = last_word("b", status, is_in, said, complaint)
    assert isinstance(found, Lost)
    assert found.words.startswith(words)


def test_what_somebody_has_to_change() -> None:
    denied = "root@b: Permission denied (publickey).\n"
    assert isinstance(last_word("b", 255, False, "", denied), Refused)
    assert isinstance(last_word("b", 127, True, "", ""), Refused)
