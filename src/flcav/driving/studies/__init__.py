"""Studies over many drives: errors of the networks, importance of tasks, what roadside units and seen lanes bring."""
