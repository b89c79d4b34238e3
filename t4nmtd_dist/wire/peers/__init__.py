"""How learners reach each other."""
