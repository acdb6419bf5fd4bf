"""Scripted corner cases in simulated traffic, such as cut-ins, crashes and pedestrians who run out.

A kind of scenario has a `cast_...` function, which assigns its roles to vehicles of the traffic, or returns None while
none fits, and a script: a generator that acts for one step of 0.1 s per `yield`. A scenario happens near a vehicle
under test, the ego ("cav0", ...).
"""
