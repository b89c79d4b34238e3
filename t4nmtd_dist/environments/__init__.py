"""Anyone's Gymnasium environment as an environment: opening it, its observations and labels, and its snapshots."""
