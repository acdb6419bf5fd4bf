"""Pictures of what sensors see and networks find."""
