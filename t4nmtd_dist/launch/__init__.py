"""Launchers: start all roles as local processes, or in lock-step in one process."""
