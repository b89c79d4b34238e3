"""Low-level RL agents, one folder each, behind one protocol."""
