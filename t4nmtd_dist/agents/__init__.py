"""Low-level learners, one folder each, behind one protocol."""
