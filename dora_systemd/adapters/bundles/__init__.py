"""Bundles on disk.

They are written part by part, read as foreign files, and kept in a store with bounds.

A bundle is a plain tar file: every machine unpacks it, a writer that fails takes one part back, and
a reader finds one part without the others. What is large and compresses well is compressed in it.
"""
