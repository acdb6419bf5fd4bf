"""The results of a run, collected from its finished steps: tests, differences, findings."""
