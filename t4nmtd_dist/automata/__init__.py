"""LTLf formulas, their automata, and the Boolean algebra of guards."""
