"""Ablation of the demo over seeds: the contribution of each stage and of the roadside sensor."""
