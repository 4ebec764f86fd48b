"""One port for all dataflows: server, routes, metrics, page. It calls verbs, and never the runner.

`__main__.py` is the main process of `dora-gateway.service`, which systemd starts at the first
connection to `dora-gateway.socket`. Only `server.py` uses the WebSocket library. It passes what
`trust/sockets.py` reads from the kernel's socket table to `decisions/gateway/request.py`,
which decides about access, and finds the route in `routes.py`, a line for each path. A route is a
function from `Request` to `Answer`, or one that uses a `Socket`. Blocking calls run in
`asyncio.to_thread`. The only state is the token, a file in the RuntimeDirectory of the socket.
The unit has no network, so the gateway has no way to other machines.
"""
