"""Outputs that nodes owe: which, the probe that receives them, which node is silent."""
