"""What no single frame shows: sensors whose view is blocked, actors whose motion and recorded speed disagree."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from flcav.sensors.frame import Frame
from flcav.world.trace import Trace

CLOSE_M = 1.0  # from a LiDAR: its mount, or what stands in its way
MOST, ALMOST_ALL = 0.5, 0.95  # shares of a LiDAR's points
LONGEST_STEP_S = 1.0  # over longer ones the speeds at both ends say little
DRIFT_M, DRIFT_MPS = 0.3, 2.5  # by how much an actor may miss what its speeds say: at once, and per second


class Sight:
    """How many of each LiDAR's points are close to it, over all frames of a dataset."""

    def __init__(self) -> None:
        self._points: Counter[tuple[str, str]] = Counter()  # by agent and LiDAR
        self._close: Counter[tuple[str, str]] = Counter()

    def add(self, frame: Frame) -> None:
        """Count the points of one frame."""
        for name, points in frame.lidar.items():
            with np.errstate(invalid="ignore"):  # signalling NaNs, which the frame's own checks tell
                close = np.linalg.norm(points[:, :3].astype(np.float64), axis=1) < CLOSE_M
            self._points[frame.agent, name] += len(points)
            self._close[frame.agent, name] += int(close.sum())

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each LiDAR whose view is blocked."""
        for (agent, name), count in self._points.items():
            share = self._close[agent, name] / max(count, 1)
            told = f"{share:.1%} of its {count} points lie within {CLOSE_M:g} m of it"
            if share >= ALMOST_ALL:
                yield f"{agent}: '{name}' sees almost nothing but its own mount: {told}"
            elif share > MOST:
                yield f"{agent}: the view of '{name}' is blocked: {told}"


def check_motion(scene: str, trace: Trace) -> Iterator[str]:
    """Check that every actor moves from instant to instant as its recorded velocities say; the worst of each is told.

    Where the actor should be is the trapezoidal sum of the velocities at both ends of a step.
    """
    step_s = np.diff(trace.time_s)[:, None]
    moved = np.diff(trace.position, axis=0)
    expected = (trace.velocity[1:] + trace.velocity[:-1]) / 2 * step_s[..., None]
    away = np.linalg.norm((moved - expected)[..., :2], axis=2)
    known = (step_s <= LONGEST_STEP_S) & ~np.isnan(away)
    excess = np.where(known, away - (DRIFT_M + DRIFT_MPS * step_s), -1.0)
    for actor in np.flatnonzero(excess.max(axis=0, initial=-1.0) > 0):
        t = int(excess[:, actor].argmax())
        speeds = np.linalg.norm(trace.velocity[t : t + 2, actor], axis=1)
        yield (
            f"scene '{scene}': {trace.category[actor]} '{trace.actor[actor]}' moves "
            f"{np.linalg.norm(moved[t, actor]):.2f} m from {trace.time_s[t]:g} s to {trace.time_s[t + 1]:g} s, "
            f"at recorded speeds of {speeds[0]:.1f} and {speeds[1]:.1f} m/s"
        )
