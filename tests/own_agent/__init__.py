"""An agent of a user's own, as far as its settings go."""
