"""User interface in Python: lazy public names, documentation of fields, wording of messages, progress bars."""
