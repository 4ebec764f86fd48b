"""pystemd.dbuslib without pystemd/__init__.py; the only module that imports pystemd.

That imports lxml and the signatures of all unit properties, which takes longer than the whole of
`doractl list`. A package that holds nothing but its path stands in while the import runs, and so
does a function for pprint's, which dbuslib has for debugging and which imports the compiler. This
is a module, as Python runs one once and lets other threads wait: the gateway has many.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

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
    # Whoever has pprint already keeps it.
    stand_ins = {"pprint": _late_pprint(), "pystemd": package}
    absent = [name for name in stand_ins if name not in sys.modules]
    sys.modules.update({name: stand_ins[name] for name in absent})
    try:
        return import_module("pystemd.dbuslib")
    finally:
        for name in absent:
            del sys.modules[name]


def _late_pprint() -> ModuleType:
    def pformat(*arguments: Any, **options: Any) -> str:
        text: str = import_module("pprint").pformat(*arguments, **options)
        return text

    module = ModuleType("pprint")
    module.__dict__["pformat"] = pformat
    return module


dbuslib = _load()
