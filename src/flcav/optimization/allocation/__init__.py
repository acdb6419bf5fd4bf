"""Multi-layer graph resource allocation (MLGRA): the problem, its optimal plan, baselines, replanning."""
