"""`doractl bundle` and `bundles`.

A bundle is the evidence of a failure in one file. `collect.py` has a section for each of its parts,
a new part is one more section. `write.py` writes them, `listing.py` lists and removes bundles.
"""
