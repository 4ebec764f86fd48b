"""The output of nodes: pipes, queues, dora's log files.

Lines go from a FIFO to journald's socket, and never through dora. If dora's daemon must read the
output of a node itself, `jsonl.py` follows the daemon's log files, and `runner/nodes/groups.py`
freezes the node's group while too much of them is unread: nothing else would slow the node.
"""
