"""Argoverse 2's sensor dataset: read (`read`). Wilson et al., "Argoverse 2", NeurIPS Datasets and Benchmarks 2021."""
