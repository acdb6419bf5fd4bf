"""Adaptive search for failures against quasi-random sampling."""
