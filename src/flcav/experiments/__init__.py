"""Reproductions of the article's figures, comparisons of arms and plans, and the studies of tasks."""
