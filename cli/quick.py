"""Parses the common forms of `doractl list` without click; click parses all other command lines."""

from typing import Any, NamedTuple

LIST_VERBS = ("list", "ps", "status")

_FLAGS: dict[str, tuple[str, Any]] = {
    "-a": ("want_all", True),
    "--all": ("want_all", True),
    "--user": ("is_user", True),
    "--system": ("is_user", False),
    "--output=json": ("output", "json"),
    "--output=table": ("output", "table"),
}
_VALUES = ("json", "table")


class ListRequest(NamedTuple):
    """A `doractl list` command. is_user: None without --user and --system."""

    selector: str | None = None
    want_all: bool = False
    output: str = "table"
    is_user: bool | None = None


def parse_quick_list(arguments: list[str]) -> ListRequest | None:
    """The request in `list [--all] [--user|--system] [-o json|table] [SELECTOR]`, else None.

    None also for every wrong command line: click reports the error.
    """
    if not arguments or arguments[0] not in LIST_VERBS:
        return None
    request = ListRequest()
    rest = iter(arguments[1:])
    for word in rest:
        if word in ("-o", "--output"):
            value = next(rest, "")
            found = ("output", value) if value in _VALUES else None
        elif not word.startswith("-") and word and request.selector is None:
            found = ("selector", word)
        else:
            found = _FLAGS.get(word)
        if found is None:
            return None
        change: dict[str, Any] = dict([found])
        request = request._replace(**change)
    return request
