"""Release candidates: a folder of weights, card, provenance and evaluation, and the signatures of its approval."""
