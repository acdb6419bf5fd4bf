"""The remote procedure calls of CARLA's clients about actors: of all kinds, vehicles, walkers and traffic lights."""

import numpy as np

from flcav.carla.frames import mirror, mirror_spin, to_vector
from flcav.carla.server import wire
from flcav.carla.server.actors import NOTHING, ServedActor, describe_physics, describe_telemetry
from flcav.carla.server.blueprints import CallRefused, Quality, list_blueprints
from flcav.carla.server.episode import Episode
from flcav.carla.server.wire import BoundingBox, Transform, Vector
from flcav.world.commands import FreezeLights

DEFAULT_DT_S = 0.05  # of a tick where the client sets none
BODIES = ("vehicle", "walker", "static")
TIMES = {"green": 0, "yellow": 1, "red": 2}


class ActorCalls:
    """The calls of `flcav.carla.server.calls.Calls` that concern actors."""

    episode: Episode
    settings: wire.EpisodeSettings
    _port: int
    _quality: Quality

    @property
    def dt_s(self) -> float:
        """The length of a tick [s]."""
        return DEFAULT_DT_S if self.settings.fixed_dt_s is None else self.settings.fixed_dt_s

    # ---- actors

    def get_actor_definitions(self) -> wire.Packed:
        """Return all blueprints."""
        return [blueprint.definition for blueprint in list_blueprints(self._quality).values()]

    def get_spectator(self) -> wire.Packed:
        """Return the spectator."""
        return self._record(self.episode.spectator)

    def get_actors_by_id(self, numbers: tuple[int, ...]) -> wire.Packed:
        """Return the records of actors by id; destroyed ones are left out."""
        known = self.episode.actors
        return [self._record(known[number]) for number in numbers if number in known]

    def _record(self, actor: ServedActor) -> wire.ActorRecord:
        return actor.record(self._port + 1)

    def spawn_actor(self, description: wire.Description, transform: Transform) -> wire.Packed:
        """Spawn an actor; return its record."""
        return self._record(self.episode.spawn(description, transform))

    def spawn_actor_with_parent(
        self,
        description: wire.Description,
        transform: Transform,
        parent: int,
        attachment: int,
        socket: wire.Packed = "",
    ) -> wire.Packed:
        """Spawn an actor attached to another one; the attachment is always rigid."""
        return self._record(self.episode.spawn(description, transform, parent))

    def destroy_actor(self, actor: int) -> bool:
        """Destroy an actor."""
        self.episode.destroy(self.episode.find(actor))
        return True

    def set_actor_location(self, actor: int, location: Vector) -> None:
        """Set an actor's location [m], keeping its rotation."""
        found = self.episode.find(actor)
        self.episode.place(found, found.transform._replace(location=location))

    def set_actor_transform(self, actor: int, transform: Transform) -> None:
        """Set an actor's transform."""
        self.episode.place(self.episode.find(actor), transform)

    def set_walker_state(self, actor: int, transform: Transform, speed: float) -> None:
        """Set the transform and speed [m/s] of a walker; the location is that of its feet, moved onto the ground."""
        walker = self.episode.body(actor, "walker")
        east, north, height = self.episode.served.frame.from_location(transform.location).tolist()
        x, y, z = transform.location
        z += self.episode.world.height(east, north, height) - height + walker.lift
        self.episode.place(walker, Transform((x, y, z), transform.rotation))
        self.episode.push(walker, speed * walker.pose[:3, 0])
        ahead = mirror(walker.pose[:3, 0])
        walker.walk = wire.WalkerControl((float(ahead[0]), float(ahead[1]), 0.0), speed)
        walker.guided_s = self.episode.time_s

    def set_actor_target_velocity(self, actor: int, velocity: Vector) -> None:
        """Set an actor's velocity [m/s]."""
        self.episode.push(self.episode.body(actor, *BODIES), mirror(np.array(velocity)))

    def set_actor_target_angular_velocity(self, actor: int, rate: Vector) -> None:
        """Set an actor's yaw rate: the vertical component of the angular velocity `rate` [deg/s]."""
        self._turn(self.episode.body(actor, *BODIES), float(mirror_spin(np.radians(rate))[2]))

    def enable_actor_constant_velocity(self, actor: int, velocity: Vector) -> None:
        """Keep a vehicle's velocity [m/s], in the vehicle frame, constant."""
        self.episode.body(actor, "vehicle").constant = mirror(np.array(velocity))

    def disable_actor_constant_velocity(self, actor: int) -> None:
        """Return a vehicle to its controls."""
        self.episode.body(actor, "vehicle").constant = None

    def add_actor_impulse(self, actor: int, impulse: Vector) -> None:
        """Apply an impulse [N s] to an actor."""
        body = self.episode.body(actor, *BODIES)
        velocity, _ = self.episode.motion(body)
        self.episode.push(body, velocity + mirror(np.array(impulse)) / self._mass(body))

    def add_actor_force(self, actor: int, force: Vector) -> None:
        """Apply a force [N] to an actor for one tick."""
        x, y, z = force
        self.add_actor_impulse(actor, (x * self.dt_s, y * self.dt_s, z * self.dt_s))

    def add_actor_impulse_at_location(self, actor: int, impulse: Vector, location: Vector) -> None:
        """Apply an impulse [N s] at the centre of the actor, whatever the location."""
        self.add_actor_impulse(actor, impulse)

    def add_actor_force_at_location(self, actor: int, force: Vector, location: Vector) -> None:
        """Apply a force [N] at the centre of the actor, whatever the location."""
        self.add_actor_force(actor, force)

    def add_actor_angular_impulse(self, actor: int, impulse: Vector) -> None:
        """Apply the vertical component of an angular impulse [N m s] to an actor."""
        body = self.episode.body(actor, *BODIES)
        inertia = self.episode.world.bodies.find(body.name).blueprint.inertia_kgm2
        _, rate = self.episode.motion(body)
        self._turn(body, rate + float(mirror_spin(np.array(impulse))[2]) / inertia)

    def add_actor_torque(self, actor: int, torque: Vector) -> None:
        """Apply the vertical component of a torque [N m] to an actor for one tick."""
        x, y, z = torque
        self.add_actor_angular_impulse(actor, (x * self.dt_s, y * self.dt_s, z * self.dt_s))

    def _turn(self, body: ServedActor, yaw_rate: float) -> None:
        velocity, _ = self.episode.motion(body)
        self.episode.push(body, velocity, yaw_rate)

    def _mass(self, body: ServedActor) -> float:
        return self.episode.world.bodies.find(body.name).blueprint.mass_kg

    def set_actor_simulate_physics(self, actor: int, on: bool) -> None:
        """Switch an actor's physics on or off."""
        self.episode.simulate(self.episode.body(actor, *BODIES), physics=on)

    def set_actor_enable_gravity(self, actor: int, on: bool) -> None:
        """Switch an actor's gravity on or off."""
        self.episode.simulate(self.episode.body(actor, *BODIES), gravity=on)

    def set_actor_collisions(self, actor: int, on: bool) -> None:
        """Switch collisions on; off is refused, except for walkers, whose AI requests it: they keep colliding."""
        if not on and self.episode.find(actor).kind != "walker":
            raise CallRefused("set_collisions(False) is not served: actors always collide")

    def set_actor_dead(self, actor: int) -> None:
        """Stop an actor permanently."""
        self.episode.simulate(self.episode.body(actor, *BODIES), physics=False)

    def set_actor_autopilot(self, actor: int, on: bool, port: wire.Packed = None) -> None:
        """Accept that a client's Traffic Manager drives a vehicle."""
        self.episode.find(actor, "vehicle", "walker")

    def get_actor_bounding_box(self, actor: int) -> BoundingBox:
        """Return an actor's bounding box; an empty one if it is destroyed, since Traffic Managers still ask for it."""
        found = self.episode.actors.get(actor)
        return BoundingBox(NOTHING, NOTHING) if found is None else found.bounding_box()

    def get_actor_component_names(self, actor: int) -> wire.Packed:
        """Return the names of an actor's components: none."""
        self.episode.find(actor)
        return []

    get_actor_bone_names = get_actor_socket_names = get_actor_component_names
    get_actor_bone_world_transforms = get_actor_bone_relative_transforms = get_actor_component_names
    get_actor_socket_world_transforms = get_actor_socket_relative_transforms = get_actor_component_names

    # ---- vehicles and walkers

    def apply_control_to_vehicle(self, actor: int, control: wire.VehicleControl) -> None:
        """Set a vehicle's control."""
        vehicle = self.episode.body(actor, "vehicle")
        vehicle.ackermann = None
        self.episode.drive(vehicle, control)

    def apply_ackermann_control_to_vehicle(self, actor: int, control: wire.AckermannControl) -> None:
        """Set a vehicle's Ackermann control."""
        self.episode.body(actor, "vehicle").ackermann = control

    def get_ackermann_controller_settings(self, actor: int) -> wire.Packed:
        """Return the gains of CARLA's Ackermann controller."""
        self.episode.find(actor, "vehicle")
        return [0.15, 0.0, 0.25, 0.01, 0.0, 0.01]

    def apply_ackermann_controller_settings(self, actor: int, settings: wire.Packed) -> None:
        """Set the gains of CARLA's Ackermann controller, which is not served."""
        raise CallRefused("apply_ackermann_controller_settings is not served: the controller here has no gains")

    def apply_control_to_walker(self, actor: int, control: wire.WalkerControl) -> None:
        """Set a walker's control."""
        self.episode.walk(self.episode.body(actor, "walker"), control)

    def get_physics_control(self, actor: int) -> wire.Packed:
        """Return a vehicle's physics control."""
        vehicle = self.episode.find(actor, "vehicle")
        return describe_physics(vehicle, self.episode.world)

    def apply_physics_control(self, actor: int, physics: wire.Packed) -> None:
        """Set a vehicle's physics control: no effect, the physics follows from its size."""
        self.episode.find(actor, "vehicle")

    def get_telemetry_data(self, actor: int) -> wire.Packed:
        """Return a vehicle's telemetry."""
        vehicle = self.episode.find(actor, "vehicle")
        return describe_telemetry(vehicle, self.episode.speed(vehicle))

    def show_vehicle_debug_telemetry(self, actor: int, on: bool) -> None:
        """Show a vehicle's telemetry: no effect, there is no window."""
        self.episode.find(actor, "vehicle")

    def get_vehicle_light_state(self, actor: int) -> wire.Packed:
        """Return the flags of a vehicle's lamps."""
        return [self.episode.find(actor, "vehicle").lamps]

    def set_vehicle_light_state(self, actor: int, lamps: wire.Packed) -> None:
        """Set the flags of a vehicle's lamps."""
        flags = lamps[0] if isinstance(lamps, list) and lamps else lamps
        self.episode.find(actor, "vehicle").lamps = wire.read(int, flags) & 0xFFFFFFFF

    def get_vehicle_light_states(self) -> wire.Packed:
        """Return the flags of the lamps of all vehicles."""
        return [[actor.id, actor.lamps] for actor in self.episode.actors.values() if actor.kind == "vehicle"]

    def open_vehicle_door(self, actor: int, door: int) -> None:
        """Open a door: refused, vehicles here have none that open."""
        raise CallRefused("open_door is not served: vehicles here have no doors that open")

    def close_vehicle_door(self, actor: int, door: int) -> None:
        """Close a door: no effect."""
        self.episode.find(actor, "vehicle")

    def set_wheel_steer_direction(self, actor: int, wheel: int, angle_deg: float) -> None:
        """Turn a wheel visually: refused."""
        raise CallRefused("set_wheel_steer_direction is not served: wheels follow the steering")

    def get_wheel_steer_angle(self, actor: int, wheel: int) -> float:
        """Return the angle of a wheel [deg]."""
        vehicle = self.episode.find(actor, "vehicle")
        if wheel >= 2 or not self.episode.is_own(vehicle):
            return 0.0
        limit, _ = self.episode.steering(vehicle)
        return float(np.degrees(limit) * vehicle.control.steer)

    def get_bones_transform(self, actor: int) -> wire.Packed:
        """Return a walker's bones: none."""
        self.episode.find(actor, "walker")
        return [[]]

    def set_bones_transform(self, actor: int, bones: wire.Packed) -> None:
        """Set a walker's bones: refused."""
        raise CallRefused("set_bones is not served: walkers here have no bones")

    def blend_pose(self, actor: int, share: float) -> None:
        """Blend a walker's pose: refused."""
        raise CallRefused("blend_pose is not served: walkers here have no bones")

    # ---- traffic lights

    def _light(self, actor: int) -> int:
        row = self.episode.find(actor).light
        if row is None:
            raise CallRefused(f"actor {actor} is no traffic light")
        return row

    def set_traffic_light_state(self, actor: int, state: int) -> None:
        """Set a traffic light's state."""
        self.episode.lights.set_state(self.episode.world, self._light(actor), state)

    def set_traffic_light_green_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays green after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["green"]] = seconds

    def set_traffic_light_yellow_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays yellow after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["yellow"]] = seconds

    def set_traffic_light_red_time(self, actor: int, seconds: float) -> None:
        """Set the time [s] for which a light stays red after it was set."""
        self.episode.lights.times_s[self._light(actor)][TIMES["red"]] = seconds

    def freeze_traffic_light(self, actor: int, frozen: bool) -> None:
        """Freeze all traffic lights, not only this one, as CARLA does."""
        self._light(actor)
        self.freeze_all_traffic_lights(frozen)

    def freeze_all_traffic_lights(self, frozen: bool) -> None:
        """Freeze or unfreeze all traffic lights."""
        self.episode.lights.frozen = frozen
        self.episode.world.apply(FreezeLights(frozen))

    def reset_traffic_light_group(self, actor: int) -> None:
        """Return the lights of a junction to their program."""
        row = self._light(actor)
        self.episode.lights.release(self.episode.world, self.episode.lights.approaches[row].junction)

    def reset_all_traffic_lights(self) -> None:
        """Return all lights to their programs."""
        self.episode.lights.release(self.episode.world)

    def get_group_traffic_lights(self, actor: int) -> wire.Packed:
        """Return the actor ids of the lights of a junction."""
        return [self.episode.light_number(row) for row in self.episode.lights.group(self._light(actor))]

    def get_light_boxes(self, actor: int) -> wire.Packed:
        """Return the bounding boxes of a traffic light's heads."""
        actor_found = self.episode.find(actor)
        self._light(actor)
        place = to_vector(self.episode.served.frame.to_location(actor_found.pose[:3, 3] + (0.0, 0.0, 2.9)))
        return [BoundingBox(place, (0.15, 0.15, 0.45), actor_found.transform.rotation)]
