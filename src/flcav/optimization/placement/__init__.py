"""VRCSP, placement of roadside sensors on poles, as weighted maximum coverage of the registered perception errors.

A sensor at x covers an error at e where ||e - x|| <= range, in three dimensions: Wang et al., IEEE Network 37(3), 2023.
`solve.py` maximises the covered weight under a budget, `cheapest.py` minimises the cost of a share of it.
"""
