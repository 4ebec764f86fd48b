"""What the head says of the machines that it waits for. Pure."""

from collections.abc import Mapping

NOT_CONNECTED = "it is not connected yet"
NOT_JOINED = "it has not answered yet"
USUAL = (NOT_CONNECTED, NOT_JOINED)
"""What each start waits for, for a moment."""
ENDED = "the connection has ended"
"""Of a link before it says more."""
_BEGIN = "waiting for machine"


def format_missing(missing: Mapping[str, str]) -> str:
    """The machines that are missing, by name, and why."""
    word = "machine" if len(missing) == 1 else "machines"
    return f"{word} {', '.join(f'{name} ({why})' for name, why in missing.items())}"


def is_news(text: str) -> bool:
    """Whether the stage of a start is more than what each start waits for."""
    for one in (*USUAL, ENDED):
        text = text.replace(f"({one})", "")
    return text.startswith(_BEGIN) and "(" in text
