"""The run directory: settings, events, metrics, summary and the exported policy of one training."""
