"""The findings of `doractl doctor`: one line each, with a remedy."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


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


def format_findings(findings: Sequence[Finding]) -> str:
    """A line for each finding, and the remedy on the next line."""
    width = max(len(one.topic) for one in findings)
    lines = []
    for one in findings:
        lines.append(f"{one.state:<7}  {one.topic:<{width}}  {one.text}")
        if one.remedy:
            lines.append(f"{'':<{width + 11}}-> {one.remedy}")
    return "\n".join(lines)


def finding_values(one: Finding) -> dict[str, str | None]:
    """The finding for JSON."""
    return {
        "topic": one.topic,
        "state": one.state,
        "text": one.text,
        "remedy": one.remedy or None,
    }
