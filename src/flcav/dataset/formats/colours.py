"""Colours of actor classes and signs for viewers."""

COLOURS = {  # red, green, blue, each 0 to 1
    "car": (0.20, 0.55, 0.95),
    "van": (0.10, 0.75, 0.80),
    "truck": (0.95, 0.55, 0.15),
    "bus": (0.90, 0.75, 0.10),
    "motorcycle": (0.75, 0.35, 0.90),
    "bicycle": (0.45, 0.80, 0.30),
    "pedestrian": (0.95, 0.30, 0.40),
}
OTHER = (0.6, 0.6, 0.6)
SIGN = (1.0, 0.95, 0.3)
