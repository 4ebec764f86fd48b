"""Finds the options of the last deploy that the next one has forgotten. Pure."""

from collections.abc import Mapping, Sequence

from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.table import ENV, PROPERTY, SETTINGS, WORKING_DIRECTORY

Texts = Mapping[str, str | Sequence[str]]
"""Options by name of the setting, as of given_texts()."""
_WITHOUT_VALUES = (ENV, PROPERTY, WORKING_DIRECTORY)
"""Their values may be secrets, or a directory that is gone."""


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
