"""What the head hears when a connection has ended."""

import pytest

from dora_systemd.decisions.machines.wire import Lost, Unreached
from dora_systemd.link.end_reason import last_word

OF_DORACTL = "doractl: it has no address 10.99.0.2\nhint: see machines in dora-systemd.yml(5)\n"


@pytest.mark.parametrize(
    ("status", "said", "complaint", "words"),
    [
        (255, "", "client_loop: send disconnect: Broken pipe\n", "client_loop: send"),
        (0, "", "", "it has ended"),
        (-15, "", "", "exit status -15"),
    ],
)
def test_what_may_pass(status: int, said: str, complaint: str, words: str) -> None:
    found = last_word("b", status, True, said, complaint)
    assert isinstance(found, Lost)
    assert found.words.startswith(words)


def test_another_key_than_that_of_the_machine_is_no_way_in() -> None:
    found = last_word("b", 8, True, "", OF_DORACTL)
    assert isinstance(found, Unreached)
    assert (found.tries, found.hint) == (0, "see machines in dora-systemd.yml(5)")


@pytest.mark.parametrize("reason", ["No route to host", "Connection refused", "timed out"])
def test_a_machine_that_may_boot(reason: str) -> None:
    words = f"connect to host b port 22: {reason}"
    assert last_word("b", 255, False, "", f"ssh: {words}\n") == Lost(words)


@pytest.mark.parametrize(
    ("complaint", "words", "hint"),
    [
        (OF_DORACTL, "it has no address 10.99.0.2", "see machines in dora-systemd.yml(5)"),
        ("", "exit status 1", ""),
    ],
)
def test_the_words_of_doractl(complaint: str, words: str, hint: str) -> None:
    found = last_word("b", 1, True, "", complaint)
    assert isinstance(found, Unreached)
    assert found.reason == f"doractl on b has failed: {words}"
    assert found.hint == hint
    assert found.tries
