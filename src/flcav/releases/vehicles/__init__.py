"""A vehicle's side of releases: fetching, verification and atomic installation."""
