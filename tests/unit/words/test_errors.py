"""What an exception says to a person."""

import errno

import pytest

from dora_systemd.errors import words_of


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "Broken pipe"),
        (OSError(errno.ECONNREFUSED, "Connect call failed ('::1', 1)"), "Connection refused"),
        (OSError("Multiple exceptions"), "Multiple exceptions"),
        (TimeoutError(), "TimeoutError"),
        (ValueError("no"), "no"),
    ],
)
def test_words_of(error: Exception, said: str) -> None:
    assert words_of(error) == said
