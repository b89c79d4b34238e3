"""Code shared by agents."""
