"""Dataset formats of the field, written and read: `formats.EXPORTS`, `formats.IMPORTS`."""
