"""Where the gap between pretraining and ground truth is, of recipes/runs/gap.yaml."""
