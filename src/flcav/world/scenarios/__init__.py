"""Scripted corner cases beside sampled traffic: something dangerous happens near a vehicle, and the traffic reacts."""
