"""A node on another machine, as dora gets it. Pure.

The descriptor says where it runs. How, the member itself knows: the program is a line of Perl that
does what the file launch/NODE in that machine's cell says. Perl and no shell, as for launcher.pl.
"""

import shlex
from collections.abc import Mapping
from typing import Any

_BUILT = ("build", "git", "branch", "tag", "rev")
_LAUNCH = '$f = "$ENV{DORA_SYSTEMD_CELL}/launch/%s"; do $f; die "cannot run $f: $@$!\\n"'


def placed_node(node: str, raw: Mapping[str, Any], machine: str, perl: str) -> dict[str, Any]:
    """The node for dora; with_works() fills in the directory. raw: with its restart keys."""
    kept = {key: value for key, value in raw.items() if key not in _BUILT}
    deploy = {"machine": machine, "working_dir": None}
    return {**kept, "deploy": deploy, "path": perl, "args": shlex.join(["-e", _LAUNCH % node])}
