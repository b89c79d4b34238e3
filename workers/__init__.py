"""The workers: learners, their critic services, and the evaluator."""
