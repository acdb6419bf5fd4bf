"""A session with CARLA's server: a fresh world for a scene, in synchronous mode, and errors that name the scene.

In synchronous mode CARLA waits for the client's ticks, so that no state is missed. Ticks are STEP_S apart, with the ten
default substeps of physics. Source: CARLA's documentation, "Synchrony and time-step" and "Traffic Manager".
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flcav.config import InputError, shorten
from flcav.interface.wording import format_install_command, suggest
from flcav.machine.locks import wait_for_turn
from flcav.sources.recipe import STEP_S, CarlaRecipe

if TYPE_CHECKING:
    import carla

LAYERED = "_Opt"  # ending of CARLA's names of maps with layers
GOODBYE_S = 2.0  # longest wait for a reply of a server that has failed


@dataclass(frozen=True)
class Session:
    """A world of CARLA in synchronous mode."""

    address: str
    timeout_s: float
    client: "carla.Client"
    world: "carla.World"
    manager: "carla.TrafficManager"

    def tick(self) -> "carla.WorldSnapshot":
        """Advance the world by STEP_S; return its new state. Raises `OSError` where another client ticks, too."""
        frame = self.world.tick(self.timeout_s)
        snapshot = self.world.get_snapshot()
        if snapshot.frame != frame or abs(snapshot.timestamp.delta_seconds - STEP_S) > STEP_S / 100:
            raise OSError(
                f"CARLA at {self.address}: after tick {frame} the world is at {snapshot.frame}, "
                f"{snapshot.timestamp.delta_seconds:g} s on: another client has taken over; let nobody else tick it"
            )
        return snapshot


def check_installed() -> None:
    """Raise `InputError` where CARLA's client is not installed."""
    try:
        import carla  # noqa: F401
    except ImportError:
        raise InputError(
            f"source: carla needs CARLA's client, which is not installed: {format_install_command('carla')}"
        ) from None


@contextmanager
def open_session(recipe: CarlaRecipe, map_name: str, scene: str, seed: int) -> Iterator[Session]:
    """Yield a session with a freshly loaded map; afterwards the server is in asynchronous mode, without vehicles.

    Recordings on this machine take turns at a server. Raises `InputError` where the server has another version or lacks
    the map, and `OSError` where the connection is lost.
    """
    import carla

    address = f"{recipe.host}:{recipe.port}"
    with wait_for_turn(f"carla-{re.sub('[^A-Za-z0-9]', '-', address)}"), _name_failures(address, scene):
        client = carla.Client(recipe.host, recipe.port)
        client.set_timeout(recipe.timeout_s)
        _check_version(client, address)
        world = _load_map(client, address, map_name)
        settings = world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP_S
        settings.substepping, settings.max_substep_delta_time, settings.max_substeps = True, STEP_S / 10, 10
        world.apply_settings(settings)
        manager = client.get_trafficmanager(recipe.traffic_port)
        manager.set_synchronous_mode(True)
        manager.set_random_device_seed(seed)
        world.set_pedestrians_seed(seed)
        try:
            yield Session(address, recipe.timeout_s, client, world, manager)
        except RuntimeError:
            client.set_timeout(GOODBYE_S)
            raise
        finally:
            _leave(client, world, manager)


@contextmanager
def _name_failures(address: str, scene: str) -> Iterator[None]:
    """Convert the RuntimeError that CARLA's client raises for all failures to an `OSError` that names the scene."""
    try:
        yield
    except RuntimeError as error:
        said = " ".join(str(error).split()) or "it gave no reason"
        raise OSError(
            f"CARLA at {address} failed in the scene {scene} ({said}); scenes before it are kept, and the same command "
            "goes on with this one"
        ) from None


def _check_version(client: "carla.Client", address: str) -> None:
    server, local = client.get_server_version(), client.get_client_version()
    if server != local:
        raise InputError(
            f"CARLA at {address} is version {shorten(server)} and the installed client {local}: they must be the same"
        )


def _load_map(client: "carla.Client", address: str, name: str) -> "carla.World":
    """Return the world of the map in its initial state."""
    known = {path.rsplit("/", 1)[-1] for path in client.get_available_maps()}
    path_name = next((candidate for candidate in (name, f"{name}{LAYERED}") if candidate in known), None)
    if path_name is None:
        others = ", ".join(sorted(known)) or "none"
        raise InputError(f"CARLA at {address} has no map {shorten(name)}; it has {others}{suggest(name, known)}")
    current = client.get_world().get_map().name.rsplit("/", 1)[-1]
    return client.reload_world() if current == path_name else client.load_world(path_name)


def _leave(client: "carla.Client", world: "carla.World", manager: "carla.TrafficManager") -> None:
    import carla

    with suppress(RuntimeError):
        actors = world.get_actors()
        for vehicle in actors.filter("vehicle.*"):  # the Traffic Manager's thread may not meet one that is gone
            vehicle.set_autopilot(False, manager.get_port())
        manager.shut_down()
        for sensor in actors.filter("sensor.*"):
            sensor.stop()
        kinds = ("sensor.", "controller.", "vehicle.", "walker.")
        client.apply_batch([carla.command.DestroyActor(actor) for actor in actors if actor.type_id.startswith(kinds)])
        settings = world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = False, None
        world.apply_settings(settings)
