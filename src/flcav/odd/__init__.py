"""Operational design domains: coverage by recordings, and scenarios and placing tasks for what is not covered."""
