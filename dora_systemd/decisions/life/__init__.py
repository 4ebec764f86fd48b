"""The life of a cell: one total table of states and events, failures, budget of a stop.

`table.py` is `step(cell, event) -> (cell, actions)`; events contain the time. `runner/cell/pump.py`
takes events through the table, and `runner/cell/dialogue.py` carries out the actions that need
dora: each answer is another event. An exception of an action, a task or a callback is an event,
too: `Failed` ends the cell in any state, `dataflow-failed` and `why` name the exception, and the
unit's Restart= applies.

    state      waits for                                         then
    booting    the coordinator's port, 30 s                      starts the daemon
    joining    the daemon's registration                         sends the descriptor
    gathering  a head: its members; a member: the head's run     sends it, or subscribes
    starting   the run id and the event subscription             opens the pipes: nodes start
    waiting    dora's start barrier                              READY=1
    running    the end of the run, or a stop request             fetches the result, or stops
    stopping   Stop's answer, the last node, 1.5 x grace + 2 s   dismisses the daemon
    closing    dora's result of the run                          dismisses the daemon
    leaving    the daemon's exit, 2 s                            exits
    ended                                                        nothing

With several machines the head and each member have a cell of their own; `machines.py` has what is
different. A lost machine is a lost run: each machine then ends its nodes without dora.

A stop has one budget, `stop_budget.py`, which also is TimeoutStopSec=. `runner/cell/clock.py`
starts it at the first SIGTERM, and gives every step at the end its timeout.
"""
