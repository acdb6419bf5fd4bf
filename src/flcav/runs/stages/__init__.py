"""The step functions of a run: each loads the results of earlier steps, calls its stage's function, saves the result.

A step's settings are one frozen record, of which its fingerprint is made. Other steps are given by name; `Work.inputs`
has their folders.
"""
