"""The roll-out of a release: shares of the fleet, shadow runs that stop it, and delivery over the radio."""
