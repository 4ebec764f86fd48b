"""What a runner receives and reports: its options, resources, rights of nodes, the live table.

`limits.py` has one line for each resource that can be limited: setting, unit property, control file
of the controller. Limits of the dataflow become unit properties. Limits of nodes are in the
runner's command line, and the runner writes them before any node starts.
ExecStart= of a loaded unit cannot change, so `doractl set` puts what it has changed of the runner's
settings into a drop-in, as one variable. A reload alone does not make systemd 257 apply new limits
to a running unit.

`rights.py` has one line for each right of a node: setting, and which values only root may set. The
unit grants all of its processes what one node needs (`unit/properties.py`), because only systemd
can. `rights_commands()` makes the programs through which launcher.pl executes each node, such as
`prlimit` and `chrt`: they set the rights of that node, and take the limits from all others. A child
tries them before the start (`adapters/host/rights.py`): only the kernel knows what it refuses. CPUs
are a limit; without a cpuset controller the launcher binds the node.
"""
