"""Closed-loop driving on perceived traffic: driver, scenarios, perception as an input, and measures."""
