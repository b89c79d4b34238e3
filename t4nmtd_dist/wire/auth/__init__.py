"""CURVE keys, and which clients may connect."""
