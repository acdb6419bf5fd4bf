"""How vehicles are driven: pedals and steering wheel of Ackermann control, and the friction of the road."""

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from flcav.carla.server.actors import Actor
from flcav.carla.server.catalogue import FLOAT, TRIGGER
from flcav.carla.server.wire import AckermannControl, VehicleControl
from flcav.world.commands import Grip
from flcav.world.dynamics.bodies import Body

PULL_MPS2, BRAKE_MPS2 = 4.0, 8.0  # accelerations that full pedals give
SHIFT_KMH = (20.0, 40.0, 60.0, 85.0, 115.0)  # at which an automatic gearbox takes the next gear
SETTLE_S = 0.5  # time in which a difference of speed is to be made up
STOPPED_MPS = 0.05


def choose_gear(control: VehicleControl, speed_mps: float) -> int:
    """Return the gear of a vehicle: the driver's, or that of an automatic gearbox at its speed."""
    if control.manual:
        return control.gear
    return -1 if control.reverse else 1 + int(np.searchsorted(SHIFT_KMH, 3.6 * abs(speed_mps)))


def find_grip(box: Actor, point: NDArray[np.float64]) -> float | None:
    """Return the share of a dry road's friction in a box of friction; None where `point` (3,) is not in the box."""
    told = {each.id: float(each.value) for each in box.description.attributes if each.type == FLOAT}
    half = [told[f"extent_{axis}"] / 100 for axis in "xyz"]
    inside = np.abs(box.pose[:3, :3].T @ (point - box.pose[:3, 3])) <= half
    return min(told["friction"], 1.0) if inside.all() else None


def list_grips(actors: Collection[Actor], bodies: Iterable[Body]) -> list[Grip]:
    """Return how the tyres of vehicles hold, by the last box of friction that each is in, where that has changed."""
    known = {actor.name: actor for actor in actors if actor.kind == "vehicle"}
    boxes, changed = [actor for actor in actors if actor.description.id == TRIGGER], []
    for body in bodies:
        if (actor := known.get(body.name)) is not None:
            shares = [share for box in boxes if (share := find_grip(box, actor.pose[:3, 3])) is not None]
            share = shares[-1] if shares else 1.0
            if body.grip != share:
                changed.append(Grip(body.name, share))
    return changed


def steer_towards(
    told: AckermannControl, now: VehicleControl, speed_mps: float, limit_rad: float, dt_s: float
) -> VehicleControl:
    """Return the control of a vehicle with the greatest steering angle `limit_rad` at `speed_mps`, for one step."""
    steer = min(max(told.steer / limit_rad, -1.0), 1.0)
    if told.steer_speed > 0:
        most = told.steer_speed / limit_rad * dt_s
        steer = min(max(steer, now.steer - most), now.steer + most)
    wanted = (told.speed - speed_mps) / SETTLE_S
    if told.acceleration > 0:
        wanted = min(max(wanted, -told.acceleration), told.acceleration)
    backwards = told.speed < 0
    push = -wanted if backwards else wanted
    if abs(told.speed) < STOPPED_MPS and abs(speed_mps) < STOPPED_MPS:
        return VehicleControl(steer=steer, brake=1.0, hand_brake=True)
    if push >= 0:
        return VehicleControl(throttle=min(push / PULL_MPS2, 1.0), steer=steer, reverse=backwards)
    return VehicleControl(steer=steer, brake=min(-push / BRAKE_MPS2, 1.0), reverse=backwards)
