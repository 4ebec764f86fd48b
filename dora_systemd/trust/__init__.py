"""What root may do with things that others own. All of doractl and of the gateway goes through it.

In system scope every path, file, socket, port and program that the owner of a dataflow or its
nodes can change is hostile. `paths` opens and reads, `programs` runs, `sockets` connects. A test
over the syntax tree holds that nobody opens, stats, runs or connects around them; "Who trusts whom"
in dora-systemd(7) says what is promised.
"""
