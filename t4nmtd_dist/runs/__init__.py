"""The run directory: settings, events, metrics, checkpoints, summary and exported policy."""
