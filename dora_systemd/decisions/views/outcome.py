"""The outcome of a verb for one subject: a line of text, or a JSON object."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import Named

DONE, UNCHANGED, FAILED = "done", "unchanged", "failed"


class Subject(Named, Protocol):
    """A dataflow with its unit."""

    @property
    def unit(self) -> str:
        """The name of its unit."""


class Thing(NamedTuple):
    """A subject that is no dataflow: another unit, or "" for a file."""

    unit: str = ""
    name: str = ""
    uuid: str = ""


class Outcome(NamedTuple):
    """The result for one dataflow or Thing."""

    subject: Subject
    text: str
    problem: str = ""  # "" for success
    is_news: bool = True  # whether anything had to be done
    node: str = ""
    details: Mapping[str, Any] = {}  # what else a program may need, by key
    # hint, code, lines: as in DoraSystemdError, of a problem
    hint: str = ""
    code: ExitCode = ExitCode.FAILURE
    lines: Sequence[str] = ()

    @classmethod
    def of_error(cls, subject: Subject, error: DoraSystemdError) -> "Outcome":
        """The result for a dataflow with which the error has prevented everything."""
        what = subject, "", error.message
        return cls(*what, hint=error.hint, code=error.code, lines=error.lines)

    @property
    def error(self) -> DoraSystemdError | None:
        if not self.problem:
            return None
        return DoraSystemdError(self.problem, self.hint, self.code, self.lines)


def outcome_object(one: Outcome, action: str) -> dict[str, Any]:
    """The outcome for JSON. action: the verb, such as "stop" or "node restart"."""
    from dora_systemd.decisions.views.objects import error_object  # imported late: for JSON only

    result = FAILED if one.problem else DONE if one.is_news else UNCHANGED
    return {
        "action": action,
        "name": one.subject.name or None,
        "uuid": one.subject.uuid or None,
        "unit": one.subject.unit or None,
        "node": one.node or None,
        "result": result,
        "text": one.text.strip().partition("\n")[0] or None,
        "details": dict(one.details),
        "error": error_object(one.error) if one.error else None,
    }
