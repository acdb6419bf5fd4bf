"""Errors of poses estimated from GNSS and IMU on simulated drives: python benchmarks/bench_navigation.py [SEEDS].

Four vehicles with the sensors of the rig `car` drive through each town for 20 s before and 20 s after their first
frame; frames are 4 s apart, with sweeps every .2 s up to a second before and after each, as labels by tracks take them.
Printed are root mean squares, in the plane: of the poses of all sweeps, of what they state, of a sweep's pose relative
to that of its frame (along and across), and of single fixes beside them; and the CPU time of a minute of driving.
"""

import sys
import time

import numpy as np
from numpy.typing import NDArray

from flcav.fusion.inertial import Mounts, estimate_drive
from flcav.geometry import rotations, wrap_angle
from flcav.sensors.navigation_log import log_drive
from flcav.sensors.rig import RIGS
from flcav.world.geodesy import convert_to_map
from flcav.world.map.town import Town, load_town
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import simulate_drives

TOWNS = ("suburb", "grid", "ring", "arterial", "hilly_suburb")
FRAMES_S = np.arange(60.0, 80.1, 4.0)
AROUND_S = np.round(np.arange(-1.0, 1.01, 0.2), 1)
RIG = RIGS["car"]
MOUNTS = Mounts(RIG.gnss["gnss"].mount.agent_from_sensor(), RIG.imus["imu"].mount.agent_from_sensor())


def measure_town(name: str, seeds: int) -> str:
    """Return the errors in a town, in words."""
    town, rows, spent, driven_s = load_town(name), [], 0.0, 0.0
    for seed in range(seeds):
        times_s = np.array([FRAMES_S[0], FRAMES_S[-1] + 1])
        drives = simulate_drives(town, seed=seed, cavs=4, times_s=times_s, lead_s=20.0)[1]
        for agent in drives.actor.tolist():
            begun = time.process_time()
            rows.append(measure_drive(town, drives, agent, seed))
            spent += time.process_time() - begun
            driven_s += float(drives.time_s[-1] - drives.time_s[0])
    errors = np.concatenate(rows)
    rms = np.sqrt(np.nanmean(errors**2, axis=0))
    turned, stated, near = np.degrees(rms[1]), np.degrees(rms[3]), np.degrees(rms[6])
    return (
        f"{name}: {rms[0]:.2f} m and {turned:.2f} degrees (stated {rms[2]:.2f} m and {stated:.2f}); within a second "
        f"{rms[4]:.3f} m along, {rms[5]:.3f} m across and {near:.3f} degrees; fixes {rms[7]:.2f} m, within a second "
        f"{rms[8]:.2f} m; {60 * spent / driven_s:.2f} CPU-s a minute"
    )


def measure_drive(town: Town, drives: Trace, agent: str, seed: int) -> NDArray[np.float64]:
    """Return the errors of a vehicle's sweeps, one in each row.

    Position [m] and heading [rad], both as stated, position along and across and heading relative to the frame; of the
    fix there, and relative to that of the frame [m].
    """
    log = log_drive(drives, agent, RIG, town.geo, scene=f"{town.name}-{seed}", seed=seed)
    assert log is not None
    at_s = np.clip(FRAMES_S[:, None] + AROUND_S, FRAMES_S[0], None).ravel().round(1)
    found = estimate_drive(log, MOUNTS, town.geo, town.grounds, at_s)
    own, step = drives.actor.tolist().index(agent), np.searchsorted(drives.time_s, at_s - 1e-6)
    place, yaw = drives.position[step, own, :2], drives.yaw[step, own]
    off = found.world_from_agent[:, :2, 3] - place
    turned = wrap_angle(np.arctan2(*found.world_from_agent[:, 1::-1, 0].T) - yaw)
    middle = np.repeat(np.arange(len(FRAMES_S)) * len(AROUND_S) + len(AROUND_S) // 2, len(AROUND_S))
    along = np.stack((np.cos(yaw[middle]), np.sin(yaw[middle])), axis=1)
    left = np.stack((-along[:, 1], along[:, 0]), axis=1)
    bent = turned[middle, None] * np.einsum("ij,ij->i", place - place[middle], along)[:, None] * left
    apart = off - off[middle] - bent  # what the frame's own heading error does not explain
    tilts = np.zeros((len(step), 2)) if drives.tilt is None else drives.tilt[step, own]
    lever = rotations(yaw, *tilts.T) @ MOUNTS.agent_from_gnss[:3, 3]
    antenna = place + lever[:, :2]
    fix = convert_to_map(town.geo, log.fix[np.searchsorted(log.fix_time_s, at_s - 1e-6)])[:, :2] - antenna
    columns = (
        np.linalg.norm(off, axis=1),
        turned,
        found.deviation[:, 0] * np.sqrt(2),
        found.deviation[:, 1],
        np.einsum("ij,ij->i", apart, along),
        np.einsum("ij,ij->i", apart, left),
        wrap_angle(turned - turned[middle]),
        np.linalg.norm(fix, axis=1),
        np.linalg.norm(fix - fix[middle], axis=1),
    )
    return np.stack(columns, axis=1)


if __name__ == "__main__":
    for each in TOWNS:
        print(measure_town(each, int(sys.argv[1]) if len(sys.argv) > 1 else 3), flush=True)
