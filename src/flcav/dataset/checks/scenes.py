"""Checks over several frames: blocked LiDARs, and actors whose motion contradicts their recorded velocity."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from flcav.interface.wording import plural
from flcav.sensors.frame import Frame
from flcav.world.trace import Trace

CLOSE_M = 1.0  # points closer to the LiDAR are from its mount or an obstruction
MOST, ALMOST_ALL = 0.5, 0.95  # shares of close points from which the view is blocked, and almost entirely
LONGEST_STEP_S = 1.0  # longer steps are skipped: the velocities at both ends do not predict the motion
DRIFT_M, DRIFT_MPS = 0.3, 2.5  # tolerance of a position predicted from velocities: constant, and per second


class BlockedViews:
    """Detector of blocked LiDARs: counts the points close to each LiDAR over all frames of a dataset."""

    def __init__(self) -> None:
        self._points: Counter[tuple[str, str]] = Counter()  # by agent and LiDAR
        self._close: Counter[tuple[str, str]] = Counter()

    def add(self, frame: Frame) -> None:
        """Add the points of one frame to the counts."""
        for name, points in frame.lidar.items():
            with np.errstate(invalid="ignore"):  # signalling NaNs, which `check_values` reports
                close = np.linalg.norm(points[:, :3].astype(np.float64), axis=1) < CLOSE_M
            self._points[frame.agent, name] += len(points)
            self._close[frame.agent, name] += int(close.sum())

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each LiDAR with more than a share MOST of its points closer than CLOSE_M."""
        for (agent, name), count in self._points.items():
            share = self._close[agent, name] / max(count, 1)
            told = f"{share:.1%} of its {plural(count, 'point')} lie within {CLOSE_M:g} m of it"
            if share >= ALMOST_ALL:
                yield f"{agent}: '{name}' sees almost nothing but its own mount: {told}"
            elif share > MOST:
                yield f"{agent}: the view of '{name}' is blocked: {told}"


def check_motion(scene: str, trace: Trace) -> Iterator[str]:
    """Check that every actor moves between instants as its recorded velocities predict, by the trapezoidal rule.

    Yields one sentence for each actor that does not, about its worst step.
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
