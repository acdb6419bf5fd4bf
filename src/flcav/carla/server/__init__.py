"""A server of CARLA 0.9.16's protocol: clients drive, and sense, in a live world of flcav.

Start reading at `serve` (connections and ticks), then `calls` (what clients ask for) and `episode` (the world of one
map, and what is sent). `wire` has the bytes; `flcav.carla.frames` the left-handed frame.
"""
