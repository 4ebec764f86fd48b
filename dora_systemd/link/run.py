"""The program of a link, see __main__.py: `python3 -I -S run.py OPTIONS`.

Python without site-packages finds no dora_systemd by itself, and a link needs nothing else of them.
"""

import sys
from importlib import import_module

sys.path.append(__file__.rsplit("/", 3)[0])
sys.exit(import_module("dora_systemd.link.__main__").main())
