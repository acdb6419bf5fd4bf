"""Comparison of exchanges: what is sent, who takes part, what regions keep, what stays private."""
