"""Life cycle of an algorithm, with the interface of Stable-Baselines3."""
