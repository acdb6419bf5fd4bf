"""Groups on request in stage II: vehicles ask, are called, train together, and dissolve when their loss levels off."""
