"""Dataset formats of the field, written and read: see `formats.EXPORTS` and `formats.IMPORTS`."""
