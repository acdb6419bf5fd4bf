"""Releases of networks: candidates, their verification, two signed repositories, and vehicles that require both.

The network that drives stays as it is until its provider and its customer both acknowledge another one. `candidates`
are what is to be released; `verification` compares them with the driving network; `repositories` are the provider's and
the customer's, as Uptane has them; `vehicles` load what both name; `rollout` decides who gets it when.
"""
