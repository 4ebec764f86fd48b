"""The recorder: a node of ours that keeps the last messages of a dataflow in memory.

`keep.py` adds one node of our own to a run when all nodes are ready, which delays no start: the
program `record.py`, with the Python of the nodes, because it needs their pyarrow. That program
copies each message into the ring at once: references that it kept would fill the shared memory of
the node that sends. `keep.py` also creates the ring. systemd keeps it open, so it outlives
recorder, nodes, daemon and runner; the recorder gets it through a socket, for it is no child of the
runner. `decisions/recorder/` has the format.

It is not the probe of `owes`, though that receives outputs as well: the recorder has the lowest
priority and is killed first when memory is short, and a probe that gives way would find silent
nodes where there are none.
"""
