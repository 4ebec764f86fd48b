"""Suggests similar words for unknown ones."""

from collections.abc import Iterable

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted


def check_known(problem: str, named: Iterable[str], nodes: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for the first of `named` that is not in `nodes`.

    problem: the text before "the node", such as "cannot limit".
    """
    known = list(nodes)
    for node in named:
        if node not in known:
            message = f"{problem} the node {quoted(node)}: no such node"
            hint = did_you_mean(node, known) or f"nodes: {', '.join(known)}"
            raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint with up to three of the `known` words that are similar to `word`, or ""."""
    # Imported late: only needed after an error.
    import difflib

    by_lower = {one.lower().replace("-", "_"): one for one in known}
    wanted = word[:100].lower().replace("-", "_")
    if wanted in by_lower:
        return f"did you mean {by_lower[wanted]}?"
    near = [by_lower[one] for one in difflib.get_close_matches(wanted, by_lower, n=3)]
    return f"did you mean {' or '.join(near)}?" if near else ""
