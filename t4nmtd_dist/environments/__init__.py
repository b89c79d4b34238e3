"""Wraps Gymnasium environments: opening, observations, labels, and snapshots."""
