"""The truth about what sensors see of actors, signs and lights."""
