"""Builds the Debian packages; see packaging/build."""
