"""Ray casting: the interface of an engine (`raycaster`), and Embree 4 behind it."""
