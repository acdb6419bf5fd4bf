"""Releases of networks: candidates, their verification, two signed repositories, and vehicles that require both.

The driving network is only replaced when its provider and its customer both sign another one. `candidate` describes a
candidate, `proposal` creates it from a trained network, and `verification` compares it with the driving network;
`repositories` are those of provider and customer, as in Uptane; vehicles verify what both sign (`checking`) and install
it (`installation`); `rollout` decides which vehicles get it, and when.
"""
