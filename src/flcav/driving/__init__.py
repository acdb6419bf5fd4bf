"""Closed-loop driving on perceived traffic: driver, scenarios, perception as an input, measures, and what they teach."""
