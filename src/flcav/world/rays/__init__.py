"""Ray casting engines."""
