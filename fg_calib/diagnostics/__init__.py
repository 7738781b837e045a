"""What is wrong with a set-up, a model or a solution, and the verdict on it."""
