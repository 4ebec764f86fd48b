"""The main process of a unit, and the programs that run next to that process.

`check.py`, `build.py` and `stop_post.py` are programs. `needs.py` waits for what nodes need.
`requests.py` answers restarts and stops of single nodes; its docstring has the requests to dora
that count no restart. A stopped node that others read is a launcher that waits at its gate: the
readers keep running, and receive from the node again after a restart. dora adds a node only on the
machine of its coordinator, so on members a stop is final.

Measured from the event to the next process that is ready, median of six on a busy machine (load
20): a node that nobody reads 0.44 s with a policy and 0.40 s without; dora's own RestartNode 0.36 s
without a policy, and half a second more with one; a node that others read 0.67 s without a policy
and 0.87 s with one (two requests, between which its readers are informed).
"""
