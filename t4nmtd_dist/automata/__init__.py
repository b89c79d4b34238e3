"""LTLf formulas, their automata, and the boolean algebra of guards."""
