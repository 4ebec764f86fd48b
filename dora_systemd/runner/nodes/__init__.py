"""Groups, output, gates and watchdogs of the nodes.

`launcher.pl` runs in the node's process before the node's program. It joins `node-<id>`, opens the
node's two FIFOs (which blocks until the runner reads them), changes to the project's directory and
executes the program. dora starts operators as `python`; `libexec/python` is the first one on the
daemon's PATH and does the same for them. Other nodes that dora must start itself are moved into
their group when dora reports the pid.
"""
