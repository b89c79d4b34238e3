"""Launchers: local processes, or one lock-step process."""
