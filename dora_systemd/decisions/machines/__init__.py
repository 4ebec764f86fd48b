"""Several machines: the part of each, members, links and what they send.

    head's runner == doralink-NAME:MACHINE.service ==ssh== doractl member == member's runner

`wire.py` has what these send each other. `spread.py` gives each node its machine, from dora's
`deploy:` and the setting `machines`. `part.py` makes the part of a machine: the head sends one
descriptor, which names the machine of a member's node, and the file `launch/NODE` there has its
program. `member.py` makes the command line of `doractl member`: it stands in the unit of a link,
and never comes from a runner. The key of `doractl machine add` is in `verbs/machines/register.py`.

systemd owns a link (`link_unit.py`). The unit of the head wants it, so whatever starts the head
starts the link, in one transaction. StopWhenUnneeded= ends it with the head, but not while the head
waits for its restart.

Tokens and ports are in memory only, and new in each life. All of dora listens on 127.0.0.1, and ssh
makes the ports the same everywhere. So zenoh must not gossip (`zenoh-machines.json5`), and dora
must not have nodes dial each other. With `link: direct` zenoh and the nodes use addresses that the
settings name. These are in the command lines of all runners, and no runner sends an address, so
none can open another one.
"""
