"""What every process of the system needs: signals, the parent watchdog, import names."""
