"""Sends notices: `doranotice@NAME.service`.

    the unit of the dataflow fails      OnFailure= starts the service
    a node is given up, a machine lost  the runner writes a file: doranotice@NAME.path starts it
    a release is rolled back            doractl starts it
    the journal                         has what happened, and when the last notice was sent

The service has no other memory. It starts the command in another unit, as the user and with the
sandbox of the nodes: `unit.py` in decisions/notice/.
"""
