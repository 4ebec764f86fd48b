"""The ring of last messages, its reader, and the MCAP file that is made of it.

`ring.py` is the format and the writer, which runs in a process of the nodes' Python; `reading.py`
is the reader. The nodes' user can write to the ring at any time, so the reader believes no number
in it. `mcap.py` writes the file without pyarrow: the ring has Arrow's bytes.

Each output has a tape: positions only grow, and the place in the file is the position modulo
`span`. The window from `tail` to `head` is what counts, and the bytes outside of it are holes. So
there is no fragmentation, a message of any size is in one piece, and what all outputs use together
is one number. When that number is too large, the output that uses most loses its oldest message:
this gives each output the same share, and what one does not need belongs to the others. `head` is
written after the message, so a message that was not written to its end is not there.

Written to new pages of a memfd, 1 MB takes 0.65 ms, and 0.56 ms to pages that exist; holes are made
at 12 GB/s, CRC-32 at 1.4 GB/s. A ring of fixed shares would save that 0.1 ms, and lose the memory
that small outputs leave free.
"""
