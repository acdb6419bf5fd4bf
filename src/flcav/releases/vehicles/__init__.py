"""A vehicle's side of releases: what it fetches, what it checks, and how it installs."""
