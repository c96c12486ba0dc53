"""Run folders: what a run writes, what is read of it, and how it is told of."""
