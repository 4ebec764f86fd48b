"""Machines in a config.yml: adds and removes an entry, and leaves all other lines as they are.

Pure. The caller reads the result again, and compares: YAML has more forms than these.
"""

import re

_KEY = re.compile(r"^machines:[ \t]*(?:#.*)?$", re.MULTILINE)
_ANY = re.compile(r"^machines[ \t]*:", re.MULTILINE)


def with_machine(text: str, name: str, host: str) -> str | None:
    """The text with one more machine; None if `machines:` has a form that is not for lines."""
    entry = f"  {name}: {{host: {_scalar(host)}}}\n"
    found = _KEY.search(text)
    if found:
        end = found.end() + 1
        head = text[:end] if text[:end].endswith("\n") else f"{text[:end]}\n"
        return head + _indented(text[end:], entry) + text[end:]
    if _ANY.search(text):
        return None
    joined = text if not text or text.endswith("\n") else f"{text}\n"
    return f"{joined}machines:\n{entry}"


def without_machine(text: str, name: str) -> str | None:
    """The text without the machine; None if it does not stand there on lines of its own."""
    pattern = rf"^(?P<in>[ ]+)(?P<q>[\"']?){re.escape(name)}(?P=q):.*\n?(?:(?P=in)[ ]+.*\n?)*"
    found = re.search(pattern, text, re.MULTILINE)
    heading = _KEY.search(text)
    if not found or not heading or found.start() < heading.end():
        return None
    left = text[: found.start()] + text[found.end() :]
    after = left[heading.end() :].lstrip("\n")
    is_last = not after.startswith((" ", "\t", "#"))
    return left[: heading.start()] + after if is_last else left


def _indented(after: str, entry: str) -> str:
    """The entry as far to the right as those that are there."""
    first = re.match(r"([ ]+)\S", after)
    return f"{first[1] if first else '  '}{entry.lstrip()}"


def _scalar(text: str) -> str:
    """As YAML reads it back: no host has a quote."""
    return f'"{text}"'
