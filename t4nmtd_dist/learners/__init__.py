"""Low-level learners: attempts at a sub-task, networks, and the algorithms that train them."""
