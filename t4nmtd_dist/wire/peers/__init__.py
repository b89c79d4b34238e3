"""Clients of peers in other processes."""
