"""The doractl command: one file for each verb; the verbs below dora_systemd/ do the work."""
