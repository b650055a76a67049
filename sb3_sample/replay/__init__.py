"""Sources of batches: replay buffers, and fixed data sets."""
