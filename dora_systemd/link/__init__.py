"""The processes between the runners of head and member. Each runs as long as the dataflow.

A link is one ssh: the link ends with its ssh, and systemd starts the next link. `talk.py` is the
loop of a link; `relay.py` replaces `doractl member` when that has started the part. Both import
only what is small, and need no site-packages. `end_reason.py` decides after which ends a new
attempt can help.
"""
