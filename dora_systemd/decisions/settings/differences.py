"""Compares settings: two versions of a settings file, and the options of two deploys. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.limits import BY_KEY
from dora_systemd.decisions.cell.options import SettingText
from dora_systemd.decisions.settings.nodes import NODES
from dora_systemd.decisions.settings.resolve import Settings, runner_texts
from dora_systemd.decisions.settings.table import ENV, PROPERTY, SETTINGS, WORKING_DIRECTORY
from dora_systemd.values import INFINITY

_USUAL_WEIGHT = 100


def settings_change(before: Settings, after: Settings) -> tuple[list[SettingText], list[str]]:
    """How `after`, made from one file only, differs from `before`.

    Returns the limits of nodes that are new, as texts for the runner, and all other keys that have
    changed.
    """
    old, new = (_limits(settings) for settings in (before, after))
    both = {**old, **new}
    changed = (place for place in both if old.get(place) != new.get(place))
    limits = [new[place] if place in new else _usual(old[place]) for place in changed]
    own = {key for key in before.values if before.values[key] != after.values[key]}
    nodes = {
        f"nodes.{node}.{key}"
        for node in {**before.nodes, **after.nodes}
        for key, _ in _items(before, node) ^ _items(after, node)
        if key not in BY_KEY
    }
    return limits, sorted(own - {NODES}) + sorted(nodes)


def _limits(settings: Settings) -> dict[tuple[str, str], SettingText]:
    given = (one for one in runner_texts(settings) if one.node and one.key in BY_KEY)
    return {(one.node, one.key): one for one in given}


def _usual(gone: SettingText) -> SettingText:
    """The text that removes a limit."""
    usual = _USUAL_WEIGHT if "weight" in gone.key else INFINITY
    return gone._replace(text=BY_KEY[gone.key].format(usual))


def _items(settings: Settings, node: str) -> set[tuple[str, str]]:
    values: Mapping[str, Any] = settings.nodes.get(node, {})
    return {(key, repr(value)) for key, value in values.items()}


Texts = Mapping[str, str | Sequence[str]]
"""Options by name of the setting, as of given_texts()."""
_WITHOUT_VALUES = (ENV, PROPERTY, WORKING_DIRECTORY)
"""Settings that are shown without values: secrets, or a directory that is gone."""


def lost_options(former: Texts, now: Texts, settings: Settings) -> list[str]:
    """List the options that `former` has, as flags, and that nothing gives a value for now.

    settings: of now; a settings file counts as well.
    """
    found = []
    for setting in SETTINGS:
        value = former.get(setting.name)
        if value is None or setting.name in now or settings.is_given(setting):
            continue
        flag = setting.flags[0]
        texts = [value] if isinstance(value, str) else list(value)
        if setting.kind.is_flag:
            found.append(flag if texts == ["yes"] else f"--no-{flag.removeprefix('--')}")
        elif setting in _WITHOUT_VALUES:
            found.append(flag)
        else:
            found += [f"{flag} {text}" for text in texts]
    return found
