"""The coordinator: automaton, sub-task Q-table, initial-state buffers, leases and evaluations."""
