"""Imports pystemd.dbuslib without pystemd/__init__.py; no other module imports pystemd.

pystemd/__init__.py imports lxml and the signatures of all unit properties, which takes longer than
all of `doractl list`. During the import, an empty package with the same path replaces pystemd. A
function of ours replaces that of pprint, which dbuslib only needs for debugging, because pprint
imports the compiler. All this happens in a module because Python runs a module once and lets other
threads wait: the gateway has several.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from dora_systemd.errors import DoraSystemdError, ExitCode


def _load() -> ModuleType:
    if "pystemd" in sys.modules:
        return import_module("pystemd.dbuslib")
    spec = find_spec("pystemd")
    if spec is None:
        hint = "install python3-pystemd, or run pip install dora-systemd again"
        raise DoraSystemdError("cannot find the Python module pystemd", hint, ExitCode.NO_SYSTEMD)
    package = ModuleType("pystemd")
    package.__path__ = list(spec.submodule_search_locations or ())
    # If pprint is loaded already, it stays.
    stand_ins = {"pprint": _late_pprint(), "pystemd": package}
    absent = [name for name in stand_ins if name not in sys.modules]
    sys.modules.update({name: stand_ins[name] for name in absent})
    try:
        return import_module("pystemd.dbuslib")
    finally:
        for name in absent:
            del sys.modules[name]


def _late_pprint() -> ModuleType:
    module = ModuleType("pprint")
    vars(module)["pformat"] = lambda *words: import_module("pprint").pformat(*words)
    return module


dbuslib = _load()
