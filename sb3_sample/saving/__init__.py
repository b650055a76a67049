"""What is kept of models and of training: files that run no code, and checkpoints."""
