"""`doractl start` is a line of stages, each a module and a value that the later ones use.

    request      what is to start, and how     StartRequest
    read         the files, and whose          Files
    settings     which value counts            Settings
    where        who runs it, and from where   Where
    startable    whether it could start        LaunchPlan
    sandbox      what the nodes can reach      Sandbox
    plan         all of it, checked            Plan
    unit         the unit for systemd          properties and warnings
    start        whose name is free            Claim
    start_unit   the unit that has started     Started

A stage takes the values of those above it, and runs none of them again. `plan.make_plan` is the
first seven; `start.claim` is all but the last.
"""
