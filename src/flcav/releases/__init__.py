"""Releases of networks: candidates, their verification, two signed repositories, and vehicles that require both.

The network that drives stays as it is until its provider and its customer both acknowledge another one. `candidate` is
what is to be released, `proposal` makes it of a trained network; `verification` compares it with the driving network;
`repositories` are the provider's and the customer's, as Uptane has them; vehicles verify what both name (`checking`)
and install it (`installation`); `rollout` decides which vehicles get it when.
"""
