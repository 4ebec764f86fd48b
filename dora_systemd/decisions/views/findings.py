"""What `doractl doctor` finds: one line each about the state of a thing, and what helps."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """How bad it is. Only a problem keeps dataflows from working."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at. remedy: a command or a sentence, "" where all is well."""

    topic: str
    state: State
    text: str
    remedy: str = ""


def has_problem(findings: Sequence[Finding]) -> bool:
    """Whether anything keeps dataflows from working."""
    return any(one.state is State.PROBLEM for one in findings)


def format_findings(findings: Sequence[Finding]) -> str:
    """One line for each, with the remedy on a line of its own behind it."""
    width = max(len(one.topic) for one in findings)
    lines = []
    for one in findings:
        lines.append(f"{one.state:<7}  {one.topic:<{width}}  {one.text}")
        if one.remedy:
            lines.append(f"{'':<{width + 11}}-> {one.remedy}")
    return "\n".join(lines)


def finding_values(one: Finding) -> dict[str, str]:
    """The finding for JSON."""
    return {"topic": one.topic, "state": one.state, "text": one.text, "remedy": one.remedy}
