"""Operational design domains: what recordings cover of them, and scenarios and tasks for what they do not."""
