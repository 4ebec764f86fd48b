"""The only door to what other users own; doractl and the gateway go through it.

In system scope, every path, file, socket, port and program that the owner of a dataflow or its
nodes can change is hostile. `paths` opens and reads, `programs` runs, `sockets` connects. A unit
test checks the syntax tree of all modules: no other code may open, stat, run or connect to such
things. dora-systemd-security(7), "WHO TRUSTS WHOM", describes the guarantees.
"""
