"""Anyone's Gymnasium environment as a world: opening it, its observations and labels, and its snapshots."""
