"""Camera simulation: pinhole lens with distortion, colour images, tone mapping, thermal images."""
