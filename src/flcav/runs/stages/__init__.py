"""The step functions of a run: they load the results of earlier steps, call their stage's function, save its result.

A step's settings are one frozen record, from which its fingerprint is computed. They refer to other steps by name;
`Work.inputs` has the folders of these.
"""
