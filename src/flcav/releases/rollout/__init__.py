"""Roll-out of a release: growing shares of the fleet, shadow runs that can stop it, and delivery over the radio."""
