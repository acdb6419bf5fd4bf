"""Ground truth of a frame: 3-D boxes, occlusion and 2-D boxes of actors, signs and signal heads in images."""
