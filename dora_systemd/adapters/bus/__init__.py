"""systemd, over D-Bus.

A connection that only reads (`Bus(scope, for_reading=True)`) has a timeout of 5 s for each answer,
others have 25 s. If the message bus does not respond within one second, readers with sufficient
permissions use systemd's private socket, as systemctl does. All others fail after 5 s.
"""
