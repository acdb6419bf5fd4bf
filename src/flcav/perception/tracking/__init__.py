"""Multi-object tracking of detections: tracks with velocities, and their evaluation."""

from flcav.perception.tracking.evaluate import evaluate_tracks
from flcav.perception.tracking.tracker import Tracked, Tracker

__all__ = ["Tracked", "Tracker", "evaluate_tracks"]
