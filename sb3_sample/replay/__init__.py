"""Sources of batches: replay buffers, and transitions that are already there."""
