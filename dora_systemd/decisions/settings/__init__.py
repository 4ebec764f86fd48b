"""Settings: one declaration each for flag, key of the file and variable.

A setting is text with a key from the file to the runner, a member, `doractl set` and hot reload.
Its module reads, checks, merges and formats it. `nodes.py` has those of single nodes, by the same
keys below `nodes:` of a file and in `--node`.

A new setting that the runner obeys is an assignment in settings/<concern>.py, which is also in the
RUNNER_SETTINGS there, and a line in MODULES of cell/options.py. A new concern is joined in
table.py. The runner receives the setting as `--set=[NODE:]KEY=TEXT`, with the text of Kind.format,
and reads it with `options.of_node(node, KEY)`, `by_node(KEY)` or `of_dataflow(KEY)`. Each machine
of a dataflow gets the settings of its nodes. The names of nodes are checked; the `check` of a
setting can refuse more. Each time the dataflow is read, all this is checked again; a hot reload may
remove a node with a setting that `outlives_node`. Only the policy of restarts is read without its
module, because the runner needs it before anything else.
"""
