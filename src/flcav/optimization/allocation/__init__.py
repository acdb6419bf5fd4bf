"""Multi-layer graph resource allocation (MLGRA): problem, optimal plan, baselines, budget sweeps, replanning."""
