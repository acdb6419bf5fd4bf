"""`flcav reproduce`: its targets, and what it does for each."""
