"""One outside thing each. No adapter imports another one, but for dora's, which uses the host's."""
