#!/bin/sh
# ExecStopPost= of a dataflow's unit: stoppost.sh COMMAND [ARGUMENT...]
# What is left to say when the runner was killed is the COMMAND's business. A runner that ended by
# itself has said it, and no restart should wait for a Python that finds nothing to do.
# EXIT_CODE: see systemd.exec(5).
[ "${EXIT_CODE:-}" = exited ] || exec "$@"
