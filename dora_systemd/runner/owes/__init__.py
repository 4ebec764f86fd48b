"""The watch over owed outputs.

`watch.py` adds a probe to a run when all nodes are ready, a node of our own: `listen.py`, with an
input from each owed output. It records CLOCK_MONOTONIC in a file that it shares with the runner by
mmap(2), one number for each output; the gateway reads the same file for `/metrics`. The inputs of
nodes that owe something follow: a node that receives nothing is starved, and no restart helps. The
runner reads the file several times within the shortest time allowed; `decisions/owes/judge.py`
decides. The probe is in no table: `Dialogue` leaves out its events and its result. Each probe of a
run has an id of its own, because dora adds no node again that has ended. A probe ends when an input
ends, and the next one has the inputs that are left, so hot reload needs no code for it.
`benchmarks/owes.py` has the costs, `benchmarks/README.md` the ways that were not taken.
"""
