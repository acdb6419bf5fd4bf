"""Studies over many drives: errors of the networks, importance of tasks, benefit of roadside units."""
