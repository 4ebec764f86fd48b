"""The doractl command: click only, a file for each verb; installed as dora_systemd.cli.

All output goes through `edge.py`, a stream that escapes control characters (`terminal_text.py`).
Our own colours and sequences bypass it by `write_own`, output for programs (`show`, `export`,
`env`) by `write_exactly`, lines of nodes by `decisions/logs/terminal.py`. `screen.py` draws with
curses, and escapes each line itself.
"""
