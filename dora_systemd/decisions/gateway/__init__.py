"""Who may use the gateway, its requests and answers, frames of dora's control protocol.

`request.py` decides about access. `frames.py` and `answers.py` document what was measured with the
dora command. `page_messages.py` has what the status page sends.
"""
