"""How a verb runs on other hosts: what it needs there, and where it makes no sense."""

import sys
from typing import Any, NamedTuple

import click

from dora_systemd.decisions.remote.command_line import without_flag
from dora_systemd.decisions.remote.hosts import Way
from dora_systemd.errors import usage_error
from dora_systemd.verbs.remote.talk import ANSWER_SECONDS, SHORT_SECONDS

_REFUSED = {
    "env": "its variables lead to 127.0.0.1 there; use doractl -H HOST dora NAME -- ARGUMENT...",
}
"""Verbs whose output means nothing on another host, and what to do instead."""
_ONE_HOST = {
    "run": "use start, or one host for each run",
    "dora": "use one host for each command",
}
"""Verbs that belong to one terminal."""
ROLLOUTS = ("deploy", "rollback")
"""Verbs that some hosts get after others, and no more once a release has failed its trial."""
_LONG = ("build", "run", "dora", *ROLLOUTS)
"""Verbs that must end on the hosts when this command ends."""
_FILES = (".yml", ".yaml", ".json")
_FOLLOWING = ("is_follow", "until_end", "want_logs")
"""Options with which a verb runs until it is interrupted."""


class Plan(NamedTuple):
    """A command for other hosts."""

    verb: str  # as typed, such as "node restart"
    words: list[str]
    loud: list[str]  # the words without -q
    options: dict[str, Any]  # by name, as click reads them
    acts: bool  # it prints an outcome in each line
    wants_json: bool
    is_endless: bool  # the command runs until it is interrupted
    key: str = "host"  # what JSON calls a host

    @property
    def way(self) -> Way:
        """How the command runs on hosts, without a terminal."""
        if self.verb == "dora" and not sys.stdin.isatty():
            return Way.FED
        return Way.FOLLOWING if self.is_endless else Way.ONCE

    @property
    def has_lines(self) -> bool:
        """Whether what it prints is complete after each line."""
        return self.acts or self.is_endless

    @property
    def file(self) -> str:
        """The FILE that it reads there, or "": only the host knows its files."""
        file = str(self.options.get("dataflow") or "") if self.verb != "deploy" else ""
        return file if "/" in file or file.endswith(_FILES) else ""

    def file_hint(self, where: str, is_here: bool) -> str:
        """The hint about a FILE that the verb refused, or "". is_here: the FILE exists here."""
        if not self.file or not (is_here or self.file[0] != "/"):
            return ""
        start = "" if self.file[0] == "/" else ", and begins in the home directory there"
        here = "; the one here is not read, doractl deploy copies it" if is_here else ""
        return f"FILE is a path on {where}{start}{here}"

    @property
    def most_seconds(self) -> float | None:
        """The bound of its answer: what only looks is quick."""
        if self.has_lines or self.verb in ("logs", "dora"):
            return None
        return SHORT_SECONDS if self.verb == "list" else ANSWER_SECONDS

    @property
    def silence(self) -> float | None:
        """The longest time without a byte of its answer, if that may be long."""
        return ANSWER_SECONDS if self.verb == "logs" and not self.is_endless else None

    @property
    def follows_again(self) -> bool:
        """Whether the command connects again to a host that was lost."""
        return self.verb == "logs" and bool(self.options.get("is_follow"))


def plan_of(context: click.Context, words: list[str]) -> Plan:
    """The plan of a command line that click has accepted."""
    verb = _verb(context)
    options = dict(context.params)
    wants_json = _value(context, "output") == "json"
    endless = any(options.get(name) for name in _FOLLOWING) or verb in _LONG
    endless |= verb == "top" and wants_json and not options.get("is_once")
    holds = verb == "inhibit" and options.get("selector") is not None
    # A command that waits or holds a lock on a host must end when this command ends.
    endless |= holds or (verb in ("restart", "reload") and bool(options.get("wait")))
    acts = _acts(context) and (holds or verb != "inhibit")  # the list of locks is one text
    loud = without_flag(words, "-q", "--quiet", valued_flags(context.command))
    return Plan(verb, words, loud, options, acts, wants_json, endless)


def valued_flags(command: click.Command) -> set[str]:
    """The options of a command that have a value, but for those that can do without."""
    options = (one for one in command.params if isinstance(one, click.Option))
    valued = (one for one in options if not (one.is_flag or _may_stand_alone(one)))
    return {flag for one in valued for flag in one.opts}


def _may_stand_alone(option: click.Option) -> bool:
    """Whether its value can be left out, as that of `logs --boot`."""
    metavar = option.metavar or ""
    return metavar.startswith("[") and metavar.endswith("]")


def _verb(context: click.Context) -> str:
    names: list[str] = []
    at: click.Context | None = context
    while at and at.parent:
        names.insert(0, at.command.name or "")
        at = at.parent
    return " ".join(names)


def _acts(context: click.Context) -> bool:
    """Whether it has the options of a verb that does something, see acting_options()."""
    return any(one.name == "output" and not one.expose_value for one in context.command.params)


def _value(context: click.Context, name: str) -> object:
    return context.params.get(name) or context.meta.get(f"dora_systemd.{name}")


def check_hosts(plan: Plan, count: int) -> None:
    """Raise DoraSystemdError (USAGE) for a verb that makes no sense on that many hosts."""
    hint = _REFUSED.get(plan.verb, "")
    if hint:
        raise usage_error(f"cannot use {plan.verb} with -H", hint)
    hint = _ONE_HOST.get(plan.verb, "") if count > 1 else ""
    hint = "leave --attach out" if count > 1 and plan.options.get("want_logs") else hint
    if hint:
        raise usage_error(f"cannot {plan.verb} on several hosts", hint)
