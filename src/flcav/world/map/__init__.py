"""The map of a town: roads, lanes, markings, surfaces, street furniture."""
