"""journald: its socket, journalctl, and a reader with bounds.

What other users have written is hostile: `reader.py` ends after so many bytes and so much time, and
compares the name in a record with the unit that journald names.
"""
