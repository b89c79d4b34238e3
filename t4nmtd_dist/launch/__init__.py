"""Starting the roles: as local processes, or in lock-step in one process."""
