"""Training as Stable-Baselines3 has it: the life cycle of an algorithm."""
