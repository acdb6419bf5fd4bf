"""Links of a federation's server to its clients: in this process, in several, on Ray, to a fleet, by ROS 2 topics."""
