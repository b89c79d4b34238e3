"""Process-level basics: signals, parent watchdog, memory, import names."""
