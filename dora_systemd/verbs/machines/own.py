"""What this machine says of itself to a head that may want it as a member."""

import os
import sys
import time
from pathlib import Path

from dora_systemd.decisions.machines.facts import Facts
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name
from dora_systemd.verbs.start.linger import is_lingering
from dora_systemd.verbs.version import read_versions


def own_facts(scope: Scope) -> Facts:
    """Of the caller's account."""
    versions = read_versions(scope)
    return Facts(
        doractl=versions["doractl"] or "",
        dora=versions["dora"] or "",
        program=str(Path(sys.argv[0]).absolute()),
        user=user_name(os.getuid()),
        linger=not scope.is_user or is_lingering(scope) is not False,
        now=time.time_ns() // 1000,
    )
