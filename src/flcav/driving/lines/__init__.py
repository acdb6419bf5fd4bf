"""Lines that a driver follows beside its route: around who stands, and along the lane that a camera sees."""
