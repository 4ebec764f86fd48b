"""`doractl start --hot-reload`: the output about the files to watch."""

import os
from collections.abc import Iterator

from dora_systemd.decisions.reload.watch_rules import DEFAULT_WATCH, unmatched_patterns
from dora_systemd.values import quoted
from dora_systemd.verbs.start.plan import Plan


def watched_patterns(plan: Plan) -> tuple[str, ...]:
    """The patterns of the files that cause a reload, empty without hot reload."""
    if not plan.options.hot_reload:
        return ()
    return plan.options.reload.watch or DEFAULT_WATCH


def watch_warnings(plan: Plan) -> Iterator[str]:
    """A warning for each given pattern that matches no file.

    Only the owner of the files gets these: as root, doractl would search another user's
    directories.
    """
    if not plan.options.hot_reload or not plan.options.reload.watch or _is_anothers(plan):
        return
    # Imported late: asyncio is slow to import, and only given patterns need a search.
    from dora_systemd.adapters.host.watch import watch_rules, watched_files

    rules = watch_rules(plan.options)
    for pattern in unmatched_patterns(rules, watched_files(rules)):
        yield f"no file below {rules.root} fits --watch {quoted(pattern)}"


def _is_anothers(plan: Plan) -> bool:
    return plan.user is not None and plan.user.pw_uid != os.geteuid()
