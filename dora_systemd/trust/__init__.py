"""The only door to what others own: paths, programs, sockets, terminals.

In system scope, every path, file, socket, port and program that the owner of a dataflow or its
nodes can change is hostile. `paths` opens and reads by file descriptor, `programs` runs, `sockets`
checks the owner of a socket before it sends a byte, `sight` checks with the user's permissions,
`project` and `courier` read a project by a child that is its user. A unit test checks the syntax
tree of all modules: no other code may open, stat, run or connect to such things. A live table that
cannot be believed becomes the `problem` of its row. dora-systemd-security(7), "WHO TRUSTS WHOM",
describes the guarantees.
"""
