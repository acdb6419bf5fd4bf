"""Town maps: SUMO road networks, lanes, markings, ground surfaces and street furniture."""
