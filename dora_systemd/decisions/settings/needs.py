"""The setting `needs`: what has to be there before the dataflow, or one node, starts."""

from operator import add

from dora_systemd.decisions.cell.needs import FOREIGN, parse_needs
from dora_systemd.decisions.settings.kinds import Setting, many_texts

NEEDS = Setting[tuple[str, ...]](
    "needs",
    many_texts(
        "network, clock, dataflow:NAME, unit:NAME, mount:PATH, or a list of them; for a node "
        "paths and net:INTERFACE",
        "NEED",
        parse_needs,
        list,
        add,
    ),
    (),
    "What to wait for: network, clock, dataflow:NAME, unit:NAME, mount:PATH, NODE=PATH, or "
    "NODE=net:INTERFACE.",
    per_node=True,
    raises=lambda needs: any(one.startswith(FOREIGN) for one in needs),
)
NEED_SETTINGS = (NEEDS,)
