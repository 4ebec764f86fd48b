#!/bin/sh
# The old name of launcher.pl: a dataflow that was started before an upgrade still executes it.
exec /usr/bin/perl "${0%.sh}.pl" "$@"
