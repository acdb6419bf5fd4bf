"""Radar: echoes, detector, detections."""
