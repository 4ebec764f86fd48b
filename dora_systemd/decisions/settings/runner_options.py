"""Turns settings into the options of the runner."""

from collections.abc import Iterator
from typing import Any

from dora_systemd.decisions.cell.hot_reload import HotReload
from dora_systemd.decisions.cell.limits import BY_KEY, NodeLimits, merge_node_limits, node_limits
from dora_systemd.decisions.cell.line_rates import RateLimits, merge_rates
from dora_systemd.decisions.cell.needs import split_needs
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owed import RESTART, base_of
from dora_systemd.decisions.cell.restarts import DEFAULT, RestartPolicy, with_values
from dora_systemd.decisions.reload.watch_rules import relative_patterns
from dora_systemd.decisions.rights.node_rights import BY_KEY as RIGHTS
from dora_systemd.decisions.rights.node_rights import NodeRights, merge_node_rights
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.limits import NODE_LIMIT
from dora_systemd.decisions.settings.needs import NEEDS
from dora_systemd.decisions.settings.owes import OWES, owes_of
from dora_systemd.decisions.settings.reload import HOT_RELOAD, IGNORE, REPLACE, WATCH
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.restarts import POLICY_SETTINGS, RESTART_POLICY, START_TIMEOUT
from dora_systemd.decisions.settings.rights import NODE_RIGHTS
from dora_systemd.decisions.settings.signs import NOTIFY, WATCHDOG
from dora_systemd.decisions.settings.table import (
    ALLOW_SHELL_NODES,
    DEBUG,
    EXIT_WHEN_NODES_FINISH,
    GRACE_DURATION,
    LOG_RATE_LIMIT,
    UV,
)
from dora_systemd.decisions.signs.watchdogs import ALL_NODES, Watchdogs, merge_watchdogs

_FIELDS = {
    setting.name: field
    for setting, field in zip(POLICY_SETTINGS, RestartPolicy._fields, strict=True)
}


def with_settings(options: RunnerOptions, settings: Settings) -> RunnerOptions:
    """The options, with those that are settings. Raises DoraSystemdError."""
    return options._replace(
        uv=settings[UV],
        debug=settings[DEBUG],
        allow_shell_nodes=settings[ALLOW_SHELL_NODES],
        grace=settings[GRACE_DURATION],
        exit_when_nodes_finish=settings[EXIT_WHEN_NODES_FINISH],
        log_rates=log_rates(settings),
        node_limits=settings_node_limits(settings),
        node_rights=settings_node_rights(settings),
        restart=restart_policy(settings),
        node_restarts=node_policies(settings),
        start_timeout=settings[START_TIMEOUT],
        watchdogs=watchdogs(settings),
        needs=split_needs(settings[NEEDS], settings.by_node(NEEDS))[1],
        reload=hot_reload(settings, options.working_directory),
        owes=owes_of(settings.by_node(OWES), settings[OWES]),
    )


def log_rates(settings: Settings) -> RateLimits:
    """The limits of `log_rate_limit`, which take precedence over those of `nodes:` in files.

    Raises DoraSystemdError (BAD_INPUT).
    """
    return merge_rates(settings.by_node(LOG_RATE_LIMIT), settings[LOG_RATE_LIMIT])


def watchdogs(settings: Settings) -> Watchdogs:
    """Which nodes have a watchdog or a notify socket. Raises DoraSystemdError (BAD_INPUT)."""
    sockets = {ALL_NODES: settings[NOTIFY], **settings.by_node(NOTIFY)}
    return merge_watchdogs(settings.by_node(WATCHDOG), settings[WATCHDOG], sockets)


def settings_node_limits(settings: Settings) -> tuple[NodeLimits, ...]:
    """The limits of all nodes: those of settings files, overridden by `node_limit`."""
    given = settings[NODE_LIMIT]
    of_files = (
        node_limits(node, {BY_KEY[key].word: values[key] for key in values.keys() & BY_KEY})
        for node, values in settings.nodes.items()
    )
    return merge_node_limits(of_files, given)


def settings_node_rights(settings: Settings) -> tuple[NodeRights, ...]:
    """The rights of all nodes: those of settings files, overridden by `node_rights`."""
    given = settings[NODE_RIGHTS]
    of_files = (
        NodeRights(node, **{key: values[key] for key in values.keys() & RIGHTS})
        for node, values in settings.nodes.items()
        if values.keys() & RIGHTS
    )
    return merge_node_rights(of_files, given)


def restart_policy(settings: Settings) -> RestartPolicy:
    """The policy of the dataflow, and of its nodes without one."""
    return with_values(DEFAULT, {_FIELDS[one.name]: settings[one] for one in POLICY_SETTINGS})


def node_policies(settings: Settings) -> tuple[tuple[str, RestartPolicy], ...]:
    """The policies of nodes in settings files, based on that of the dataflow."""
    base, owes = restart_policy(settings), owes_of(settings.by_node(OWES), settings[OWES])
    return tuple(
        (node, with_values(base_of(base, owes, node), {_FIELDS[key]: values[key] for key in given}))
        for node, values in settings.nodes.items()
        if (given := values.keys() & _FIELDS)
    )


def hot_reload(settings: Settings, root: str) -> HotReload:
    """The options for hot reload; patterns are relative to `root`, the working directory.

    Raises DoraSystemdError (USAGE) for an absolute pattern outside of it.
    """
    watch, ignore = settings[WATCH], settings[IGNORE]
    of_nodes = {
        node: relative_patterns(patterns, root)
        for node, patterns in settings.by_node(WATCH).items()
    }
    for_all = [("", settings[REPLACE])] if settings.is_given(REPLACE) else []
    return HotReload(
        settings[HOT_RELOAD],
        relative_patterns(watch, root),
        relative_patterns(ignore, root),
        tuple((node, one) for node, patterns in of_nodes.items() for one in patterns),
        (*for_all, *settings.by_node(REPLACE).items()),
    )


def idle_warnings(settings: Settings) -> Iterator[str]:
    """A warning for each setting that has no effect without another one."""
    policies = {settings[RESTART_POLICY], *settings.by_node(RESTART_POLICY).values()}
    owes = (settings[OWES], *settings.by_node(OWES).values())
    policies |= {"on-failure" for one in owes for owed in one if owed.then == RESTART}
    idle: list[tuple[Setting[Any], Setting[Any]]]
    idle = [(one, RESTART_POLICY) for one in POLICY_SETTINGS[1:] if policies == {"no"}]
    idle += [(one, HOT_RELOAD) for one in (WATCH, IGNORE) if not settings[HOT_RELOAD]]
    for setting, needed in idle:
        if settings.is_given(setting):
            yield f"{setting.flags[0]} has no effect without {needed.flags[0]}"
