"""The processes between the runners of head and member. Each runs as long as the dataflow.

A link is one ssh: it ends with that, and systemd starts the next one. `talk.py` is its loop;
`relay.py` takes the place of `doractl member` when that has started the part. Both import what is
small, and need no site-packages. `end_reason.py` separates ends that waiting helps from others.
"""
