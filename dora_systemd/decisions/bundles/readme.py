"""README.txt, the first file of a bundle: what a person reads first. Pure."""

import re
from collections.abc import Iterable, Iterator, Sequence

from dora_systemd.decisions.bundles.manifest import Manifest
from dora_systemd.terminal_text import cut, one_line, wrapped
from dora_systemd.values import format_moment

_FILES = (
    ("why.json", "the report above, for programs: doractl why -o json"),
    ("journal.export.gz", "the records of this life and the last one, see below"),
    ("unit.txt", "properties of the unit; of variables only their names"),
    ("cgroup.json", "memory, CPU time, pressure and OOM kills by node"),
    ("nodes.json", "the nodes as the runner sees them"),
    ("doctor.json", "the findings of doractl doctor"),
    ("stacks/", "the stack of a node that a signal has ended"),
    ("recording.mcap", "the last messages of outputs, see RECORDER in dora-systemd-nodes(7)"),
    ("images/", "the last recorded pictures"),
    ("errors.txt", "what could not be collected"),
    ("manifest.json", "size and digest of each file, versions, what was left out"),
)
ANNOUNCEMENT = (
    "The journal, the last lines above and the recording are what nodes have written and sent, and "
    "nothing is removed from that: a secret that a node has written to its log is in this bundle."
)
_WITHOUT = "What nodes have written and sent was left out, as requested by --no-journal."
_THEN = "The report is about the failure; when the bundle was written, the dataflow was {}."
_RULES = (
    "Never in a bundle: values of environment variables, arguments of nodes and of doractl, "
    "settings, credentials, addresses of repositories."
)
_JOURNAL = (
    "Read the journal: gunzip journal.export.gz, then",
    "  /usr/lib/systemd/systemd-journal-remote -o bundle.journal journal.export",
    "  journalctl --file bundle.journal",
)


_OF_LOG = r"  (?:[0-9]{2}-[0-9]{2} )?[0-9]{2}:[0-9]{2}:[0-9]{2}  "
"""The beginning of an event, or of a line of a node: as in `why`, these are cut."""
_LABEL = r"  \S+: +|  \S+ {2,}|  "


def fitted(lines: Iterable[str], width: int) -> Iterator[str]:
    """The lines of a README.txt for a terminal of that width: all but those of logs are wrapped.

    The terminal wraps the commands: then they can be copied.
    """
    for line in lines:
        label = re.match(_LABEL, line)
        if line in _JOURNAL:
            yield line
        elif not line or re.match(_OF_LOG, line):
            yield cut(line, width)
        else:
            yield from wrapped(line, width, min(label.end(), width // 2) if label else 0)


def format_readme(manifest: Manifest, why: str, names: Sequence[str], want_journal: bool) -> str:
    """The text. why: the report of `doractl why`. names: of the files of the bundle."""
    by = f", requested by {manifest.by}" if manifest.by else ""
    title = f"Bundle of dataflow {manifest.name} on {manifest.host}"
    found = [one for one in _FILES if any(name.startswith(one[0]) for name in names)]
    width = max((len(name) for name, _ in found), default=0)
    notes = [ANNOUNCEMENT if want_journal else _WITHOUT, _RULES]
    return "\n".join(
        [
            one_line(f"{title}, {format_moment(manifest.at_us)}{by}"),
            *([one_line(_THEN.format(manifest.state))] if manifest.event else []),
            "",
            why,
            "",
            "Files:",
            *(f"  {name:<{width}}  {text}" for name, text in found),
            "",
            *notes,
            *(["", *_JOURNAL] if want_journal else []),
            "",
        ]
    )
