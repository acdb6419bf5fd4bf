"""A server of CARLA 0.9.16's protocol: clients drive vehicles and read sensors in a live world of flcav.

Start reading at `serve` (connections and ticks), then `calls` (the remote procedure calls) and `episode` (the world of
one map, and the messages to clients). `wire` is the serialisation, `flcav.carla.frames` the left-handed frame.
"""
