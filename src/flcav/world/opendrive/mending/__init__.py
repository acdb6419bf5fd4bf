"""Mending of OpenDRIVE maps before they are read: what netconvert needs, and what the reader does."""
