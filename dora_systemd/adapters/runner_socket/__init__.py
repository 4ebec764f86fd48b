"""The socket of a runner: all requests of doractl and the gateway go through it.

Only systemd sets the owner of a RuntimeDirectory: the user of the dataflow must own `runner.sock`,
and listen on it. `{"verb": "relay"}` turns the connection into one to the coordinator. The runner
copies the bytes, so the network namespace of the cell does not matter. It passes no file
descriptor: a hostile runner could share a descriptor, and make it block. `relay.py` opens a port
where the dora command needs one. `door.py` accepts connections before a runner has its code.
"""
