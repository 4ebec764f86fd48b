"""The findings of `doractl doctor`: one line each, with a remedy."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from dora_systemd.terminal_text import wrapped


class State(StrEnum):
    """The severity. Only a problem keeps dataflows from working."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """One finding. remedy: a command or a sentence, "" if everything is fine."""

    topic: str
    state: State
    text: str
    remedy: str = ""


def has_problem(findings: Sequence[Finding]) -> bool:
    """Whether a finding keeps dataflows from working."""
    return any(one.state is State.PROBLEM for one in findings)


def format_findings(findings: Sequence[Finding], width: int | None = None) -> str:
    """A line for each finding, and the remedy on the next line; wrapped to `width` columns."""
    longest = max(len(one.topic) for one in findings)
    lines = []
    for one in findings:
        lines.append((longest + 11, f"{one.state:<7}  {one.topic:<{longest}}  {one.text}"))
        if one.remedy:
            lines.append((longest + 14, f"{'':<{longest + 11}}-> {one.remedy}"))
    if width is None:
        return "\n".join(line for _, line in lines)
    return "\n".join(piece for indent, line in lines for piece in wrapped(line, width, indent))


def finding_values(one: Finding) -> dict[str, str | None]:
    """The finding for JSON."""
    return {
        "topic": one.topic,
        "state": one.state,
        "text": one.text,
        "remedy": one.remedy or None,
    }
