"""Checks of navigation logs: whole, in time, and of motions that a vehicle survives."""

from collections.abc import Iterator

import numpy as np

from flcav.dataset.checks.frames import FORCE, RATE
from flcav.sensors.navigation_log import NavigationLog

GAP = 1.5  # longest time between two IMU samples, in periods of its rate
FIX_GAP_S = 5.0  # longest time between two fixes
HIGHEST_M = 1e5


def check_log(log: NavigationLog) -> Iterator[str]:
    """Check that times ascend without gaps, numbers are finite, and places and motions possible.

    Each sentence lacks its subject, the log.
    """
    kinds = (
        ("fixes", log.fix_time_s, log.fix, FIX_GAP_S),
        ("IMU samples", log.imu_time_s, log.inertia, GAP / log.unit.rate_hz),
    )
    for kind, times_s, values, longest_s in kinds:
        if len(times_s) != len(values) or len(times_s) < 2:
            yield f"has {len(values)} {kind} at {len(times_s)} times; two or more are wanted"
            return
        if not (np.isfinite(times_s).all() and np.isfinite(values).all()):
            yield f"has {kind} that are not finite"
            return
        steps = np.diff(times_s)
        if steps.min() <= 0:
            yield f"has {kind} whose time runs backwards after {times_s[steps.argmin()]:.2f} s"
        elif steps.max() > longest_s:
            yield f"has no {kind} for {steps.max():.2f} s after {times_s[steps.argmax()]:.2f} s"
    if (np.abs(log.fix).max(axis=0) > (90, 180, HIGHEST_M)).any():
        yield "has fixes that are nowhere on Earth"
    if not (np.abs(log.inertia[:, :3]).max() < FORCE and np.abs(log.inertia[:, 3:]).max() < RATE):
        yield "reports a motion that nothing survives"
