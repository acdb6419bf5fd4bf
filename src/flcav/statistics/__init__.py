"""Statistics of claims: random streams, intervals over scenes and seeds, power and sample size, verdicts."""
