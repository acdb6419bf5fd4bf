"""Studies over many drives: errors of the networks, tasks left out, what poles give."""
