"""Statistics of claims: random streams, confidence intervals over scenes and seeds, power and sample size, verdicts."""
