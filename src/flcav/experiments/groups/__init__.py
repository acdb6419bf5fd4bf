"""Groups on request in stage II, against a fixed roster and vehicles drawn by lot."""
