"""Controlled bodies: vehicles, walkers and props that a client has spawned in a live world."""

from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError, shorten
from flcav.geometry import heading_vectors, left_vectors, wrap_angle
from flcav.world.commands import Controls
from flcav.world.dynamics.obstacles import TownGround
from flcav.world.dynamics.vehicle import (
    GRAVITY_MPS2,
    VEHICLES,
    BodyBlueprint,
    Pedals,
    PlanarMotion,
    Vehicles,
    drive_vehicles,
    stack_blueprints,
)
from flcav.world.snapshot import Actors

AT_REST = Controls()
ON_SPRINGS = ("car", "van", "truck", "bus")
ALOFT_M = 3.0  # a body placed farther above the ground than this falls; one farther below it stays there
LAUNCH_MPS = 1.0  # a body leaves the ground where its vertical velocity exceeds that of the slope by more than this
PITCH_S2PM, ROLL_S2PM = 0.004, 0.007  # lean of cars on their springs [rad] per longitudinal and lateral m/s^2
FALL_MPS = 3.0  # change of velocity by a hit beyond which a walker falls
SLIDE_MPS2 = 0.7 * GRAVITY_MPS2  # deceleration of a fallen walker on the road
MOST_LEAN_MPS2 = 10.0  # higher accelerations are those of collisions, and do not lean cars further
WALK_MPS2 = 10.0  # acceleration of walkers towards their wanted velocity, also after a hit


STATE = ("position", "velocity", "acceleration", "yaw", "yaw_rate", "steer", "tilt", "aloft")  # arrays of `Bodies`


@dataclass
class ControlledBody:
    """A vehicle, walker or prop under control, without its motion, which is in `Bodies`."""

    name: str
    blueprint: BodyBlueprint
    controls: Controls = AT_REST
    walk: tuple[float, float] = (0.0, 0.0)  # wanted velocity x, y of a walker, world frame [m/s]
    physics: bool = True
    gravity: bool = True
    fallen: bool = False  # a walker that was hit and lies on the road
    grip: float = 1.0  # friction over that of a dry road

    @property
    def category(self) -> str:
        """Return the category of the blueprint."""
        return self.blueprint.category


class Bodies:
    """The N controlled bodies and their motion in the world frame, as arrays with a row per body."""

    def __init__(self, ground: TownGround, *, leans: bool = False) -> None:
        """Start without bodies; with `leans`, cars pitch and roll on their springs."""
        self._leans = leans
        self.members: list[ControlledBody] = []
        # (N, 3) x, y, z of the underside [m], [m/s], [m/s^2]
        self.position, self.velocity, self.acceleration = (np.zeros((0, 3)) for _ in range(3))
        # (N,) [rad], [rad/s], angle of the front wheels [rad]
        self.yaw, self.yaw_rate, self.steer = (np.zeros(0) for _ in range(3))
        self.tilt = np.zeros((0, 2))  # (N, 2) pitch and roll [rad]; on the ground those of its slope
        self.size = np.zeros((0, 3))  # (N, 3) length, width, height [m]
        self.aloft = np.zeros(0, np.bool_)  # (N,) bodies with physics and gravity that are not on the ground
        self._vehicles: Vehicles = stack_blueprints([])
        self._ground = ground

    def row(self, name: str) -> int:
        """Return the row of the body `name`. Raises `InputError` for an unknown name."""
        for row, body in enumerate(self.members):
            if body.name == name:
                return row
        raise InputError(f"actor {shorten(name)}: there is none of this name under control")

    def find(self, name: str) -> ControlledBody:
        """Return the body `name`. Raises `InputError` for an unknown name."""
        return self.members[self.row(name)]

    def add(self, body: ControlledBody, x: float, y: float, yaw: float, z: float | None) -> None:
        """Add a body at rest at x, y [m] with `yaw` [rad], world frame, underside at `z` [m], None: on the ground."""
        self.members.append(body)
        for name in STATE:
            array = getattr(self, name)
            setattr(self, name, np.concatenate((array, np.zeros((1, *array.shape[1:]), array.dtype))))
        self._recast()
        self.place(len(self.members) - 1, x, y, yaw, z)

    def remove(self, row: int) -> None:
        """Remove the body in a row; later rows move up."""
        del self.members[row]
        for name in STATE:
            setattr(self, name, np.delete(getattr(self, name), row, axis=0))
        self._recast()

    def place(
        self, row: int, x: float, y: float, yaw: float, z: float | None, pitch: float = 0.0, roll: float = 0.0
    ) -> None:
        """Move a body to x, y [m], yaw, pitch, roll [rad], world frame, underside at `z` [m], None: on the ground.

        A body with physics and gravity is put onto the ground if that is within `ALOFT_M` of `z`.
        """
        self.position[row] = x, y, np.nan if z is None else z
        self.yaw[row] = wrap_angle(yaw)
        self.tilt[row] = pitch, roll
        self.aloft[row] = self.members[row].fallen = False
        if z is None:
            self._stand(np.array([row]))
        else:
            self.land(row)

    def land(self, row: int) -> None:
        """Put a body with physics and gravity onto the ground if that is within `ALOFT_M`; otherwise it is aloft."""
        body = self.members[row]
        if body.physics and body.gravity:
            self.aloft[row] = abs(self._clearance(np.array([row]))[0]) > ALOFT_M
            if not self.aloft[row]:
                self._stand(np.array([row]))

    def push(self, row: int, velocity: tuple[float, float, float]) -> None:
        """Set the velocity [m/s] of a body, world frame; pushed up, it leaves the ground."""
        self.velocity[row] = velocity
        body = self.members[row]
        if body.physics and body.gravity and not self.aloft[row]:
            climb = self._climb(np.array([row]))[0]
            self.aloft[row] = velocity[2] > climb + LAUNCH_MPS
            if not self.aloft[row]:
                self.velocity[row, 2] = climb

    def _climb(self, rows: Ints) -> Array:
        """Return the vertical velocities [m/s] of bodies that follow the slope of the ground."""
        ahead = (self.velocity[rows, :2] * heading_vectors(self.yaw[rows])).sum(axis=1)
        return -ahead * np.tan(self.tilt[rows, 0])

    def move(self, dt_s: float) -> None:
        """Integrate the motion of all bodies with physics over `dt_s` [s], before contacts are resolved."""
        on = np.array([body.physics for body in self.members], np.bool_)
        flies = on & self.aloft
        self.position[flies] += self.velocity[flies] * dt_s
        on &= ~self.aloft
        drives = on & [body.category in VEHICLES for body in self.members]
        if len(rows := np.flatnonzero(drives)):
            self._drive(rows, dt_s)
        walks = on & [body.category == "pedestrian" for body in self.members]
        if len(rows := np.flatnonzero(walks)):
            self._walk(rows, dt_s)

    def fall(self, change: Array) -> None:
        """Make walkers fall, in the direction of the hit, whose velocity changed by more than `FALL_MPS` in contacts.

        `change` (N, 2) is the change of velocity by contacts, world frame [m/s].
        """
        for row in np.flatnonzero(np.linalg.norm(change, axis=1) > FALL_MPS).tolist():
            body = self.members[row]
            if body.category == "pedestrian" and body.physics and not body.fallen:
                body.fallen = True
                self.yaw[row] = np.arctan2(change[row, 1], change[row, 0])

    def settle(self, dt_s: float) -> None:
        """Align bodies with the ground and its slope after contacts; those aloft fall for `dt_s` [s]."""
        heavy = np.array([body.physics and body.gravity for body in self.members], np.bool_)
        if len(rows := np.flatnonzero(heavy & self.aloft)):
            clearance = self._clearance(rows)
            self.velocity[rows, 2] -= GRAVITY_MPS2 * dt_s
            self.velocity[rows[clearance < -ALOFT_M]] = 0.0
            self.aloft[rows] = (clearance > 0) | (clearance < -ALOFT_M)
        if len(rows := np.flatnonzero(heavy & ~self.aloft)):
            self._stand(rows)
            self.velocity[rows, 2] = self._climb(rows)

    def weights(self) -> tuple[Array, Array]:
        """Return masses (N,) [kg] and yaw inertias (N,) [kg m^2]; infinite where contacts do not move a body."""
        held = np.array([not body.physics or body.category == "prop" for body in self.members], np.bool_)
        upright = np.array([body.category == "pedestrian" for body in self.members], np.bool_)
        mass = np.where(held, np.inf, self._vehicles.mass_kg)
        inertia = np.array([body.blueprint.inertia_kgm2 for body in self.members])
        return mass, np.where(held | upright, np.inf, inertia)

    def find_grounded(self) -> Mask:
        """Return (N,) whether bodies are within `ALOFT_M` of the ground; the others do not obstruct traffic."""
        return np.abs(self._clearance(np.arange(len(self.members)))) <= ALOFT_M

    def _clearance(self, rows: Ints) -> Array:
        """Return the height of bodies above the ground, or a bridge, [m]."""
        x, y, z = self.position[rows].T
        return z - self._ground.heights(x, y, z)

    def actors(self) -> Actors:
        """Return the current states of the bodies, world frame."""
        return Actors(
            name=tuple(body.name for body in self.members),
            category=tuple(body.category for body in self.members),
            shape=np.array([body.blueprint.shape for body in self.members], np.int64),
            size=self.size,
            position=self.position + np.where(self._lie()[:, None], self.size[:, :1] / 2 * (0.0, 0.0, 1.0), 0.0),
            yaw=self.yaw.copy(),
            velocity=self.velocity.copy(),
            acceleration=self.acceleration.copy(),
            yaw_rate=self.yaw_rate.copy(),
            tilt=self.tilt + self._find_lean(),
        )

    def _find_lean(self) -> Array:
        """Return pitch and roll (N, 2) [rad] relative to the ground: of fallen walkers, and of cars on their springs.

        A fallen walker lies with the head ahead. Cars pitch down when braking and roll outwards in a curve, in
        proportion to the acceleration.
        """
        lie: Array = np.column_stack((np.pi / 2 * self._lie(), np.zeros(len(self.members)))).astype(np.float64)
        if not self._leans:
            return lie
        cars = np.array([body.physics and body.category in ON_SPRINGS for body in self.members], np.bool_)
        felt = np.clip(self.acceleration[:, :2], -MOST_LEAN_MPS2, MOST_LEAN_MPS2)
        ahead, aside = ((felt * axis(self.yaw)).sum(axis=1) for axis in (heading_vectors, left_vectors))
        leans = np.column_stack((-PITCH_S2PM * ahead, ROLL_S2PM * aside))
        return np.asarray(lie + np.where((cars & ~self.aloft)[:, None], leans, 0.0), np.float64)

    def _lie(self) -> Mask:
        return np.array([body.fallen for body in self.members], np.bool_)

    def _recast(self) -> None:
        self._vehicles = stack_blueprints([body.blueprint for body in self.members])
        self.size = np.array([body.blueprint.size for body in self.members], np.float64).reshape(-1, 3)

    def _drive(self, rows: Ints, dt_s: float) -> None:
        controls = [self.members[row].controls for row in rows]
        pedals = Pedals(
            *(np.array([getattr(controls_of_one, name) for controls_of_one in controls]) for name in Pedals._fields),
        )
        motion = PlanarMotion(
            self.position[rows, :2], self.yaw[rows], self.velocity[rows, :2], self.yaw_rate[rows], self.steer[rows]
        )
        vehicles = Vehicles(*(values[rows] for values in self._vehicles))
        grip = np.array([self.members[row].grip for row in rows])
        vehicles = vehicles._replace(grip_mps2=grip * vehicles.grip_mps2, spin_mps2=grip * vehicles.spin_mps2)
        after = drive_vehicles(motion, vehicles, pedals, self.tilt[rows, 0], dt_s)
        self.position[rows, :2], self.yaw[rows], self.velocity[rows, :2] = after.position, after.yaw, after.velocity
        self.yaw_rate[rows], self.steer[rows] = after.yaw_rate, after.steer

    def _walk(self, rows: Ints, dt_s: float) -> None:
        fallen = np.array([self.members[row].fallen for row in rows], np.bool_)
        wanted = np.where(fallen[:, None], 0.0, np.array([self.members[row].walk for row in rows]))
        able = np.where(fallen, SLIDE_MPS2, WALK_MPS2)[:, None]
        yaw = np.where(wanted.any(axis=1), np.arctan2(wanted[:, 1], wanted[:, 0]), self.yaw[rows])
        self.yaw_rate[rows] = wrap_angle(yaw - self.yaw[rows]) / dt_s
        change = wanted - self.velocity[rows, :2]
        needed = np.linalg.norm(change, axis=1, keepdims=True)
        velocity = self.velocity[rows, :2] + change * np.minimum(1.0, able * dt_s / np.maximum(needed, 1e-12))
        self.position[rows, :2] += velocity * dt_s
        self.velocity[rows, :2], self.yaw[rows] = velocity, yaw

    def _stand(self, rows: Ints) -> None:
        upright = np.array([self.members[row].category == "pedestrian" for row in rows], np.bool_)
        self.position[rows, 2], self.tilt[rows] = self._ground.stand(
            self.position[rows], self.yaw[rows], self.size[rows], upright
        )
