"""The machine that computes: threads, worker processes, memory, and compiled functions kept on disk."""
