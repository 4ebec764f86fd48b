"""-H: the verbs of other hosts, and what is printed of them.

`dispatch.py` takes -H out of a command line and lets click read the rest here; then ssh(1) runs the
same words on each host. A new verb needs nothing: one with `acting_options` has its lines prefixed
with the host, others are printed as blocks, and JSON gets a key `host`. `plan.py` lists the verbs
that make no sense on another host, or on several. `rollout.py` takes some hosts at a time for
`deploy -H` and `rollback -H`.
"""
