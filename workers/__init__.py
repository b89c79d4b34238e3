"""The workers: learners of sub-tasks, their critic services, and the evaluator."""
