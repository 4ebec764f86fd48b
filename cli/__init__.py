"""The doractl command: one file per verb, no decision in any of them."""
