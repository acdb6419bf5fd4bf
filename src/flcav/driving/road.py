"""Cooperative perception while driving: detections of roadside units reach the ego vehicle after a latency.

A pole spins its LiDAR every `SPIN_S`; the road detector of the package finds cars in the returns in front of the pole's
static background, which is learned from sweeps of the town without actors. The latency of a message is the time of the
detector and of transmission at the rate of the V2X link (3GPP TR 37.885: `network.radio`); out of coverage no message
arrives. The vehicle extrapolates the boxes at their tracked velocities, and drops those that it detects itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.driving.seen import EGO
from flcav.fusion.road import THRESHOLD, load_road_network
from flcav.geometry import Boxes, concatenate
from flcav.network.ledger import from_names, pack_arrays
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import link_vehicles, unit_positions
from flcav.perception.objects.predict import detect
from flcav.perception.tracking import Tracked, Tracker
from flcav.sensors.lidar.background import Background, learn_background
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar_pole
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot
from flcav.world.trace import empty_trace

SPIN_S = 0.5  # between two messages of a pole
DETECTS_S = 0.1  # from the end of a spin to the boxes
STALE_S = 0.9  # older messages are not used
SAME_M = 2.5  # detections of vehicle and pole within this distance are the same road user
EMPTY_SWEEPS = 4  # of the town without actors: several, since returns are lost at random
LIDAR = "lidar"


@dataclass(frozen=True)
class RoadMessage:
    """Message of a pole: its tracks at one spin, and their time of arrival."""

    seen_s: float  # time of the spin
    arrives_s: float
    tracked: Tracked  # world frame
    megabytes: float  # size of the message [MB]


class RoadUnits:
    """The roadside units of a drive: detection, tracking and transmission."""

    def __init__(self, town: Town, poles: Sequence[int], seed: int, *, radio: Radio | None = None) -> None:
        """Take the numbers of the town's poles; raises `InputError` for one that the town does not have."""
        self.sites = unit_positions(town, poles)
        self._town, self._seed, self._radio = town, seed, radio or Radio()
        self._background = {name: learn_pole_background(town, name, seed) for name in self.sites}
        self._tracker = {name: Tracker() for name in self.sites}
        self._last: dict[str, list[RoadMessage]] = {name: [] for name in self.sites}
        self._spun_s = -SPIN_S
        self.latency_s: list[float] = []  # of the messages so far

    def receive(self, scene: Scene, snapshot: Snapshot) -> Boxes:
        """Return the boxes (world frame) that have arrived, extrapolated to this instant, which `scene` shows."""
        if snapshot.time_s - self._spun_s >= SPIN_S - 1e-6:
            self._spun_s = snapshot.time_s
            self._spin(scene, snapshot)
        parts = []
        for messages in self._last.values():
            here = [m for m in messages if m.arrives_s <= snapshot.time_s and snapshot.time_s - m.seen_s <= STALE_S]
            if here:
                newest = max(here, key=lambda m: m.seen_s)
                boxes = newest.tracked.boxes
                move = newest.tracked.velocity * (snapshot.time_s - newest.seen_s)
                centre = boxes.center + np.pad(move, ((0, 0), (0, 1)))
                parts.append(Boxes(centre, boxes.size, boxes.yaw, boxes.label, boxes.score, boxes.variance))
        return concatenate(parts) if parts else Boxes.empty()

    def _spin(self, scene: Scene, snapshot: Snapshot) -> None:
        """Detect with every roadside unit, and send the tracks."""
        links = link_vehicles(self._town, snapshot.trace, [EGO], self.sites, self._radio, self._seed)
        for number, (name, messages) in enumerate(self._last.items()):
            boxes = self._detect(scene, snapshot, name)
            tracked = self._tracker[name].step(boxes, snapshot.time_s)
            rate = float(links.rate_bps[0, 0, number])
            if rate <= 0:
                continue
            size = len(pack_tracks(tracked))
            latency = DETECTS_S + 8 * size / rate
            self.latency_s.append(latency)
            messages.append(RoadMessage(snapshot.time_s, snapshot.time_s + latency, tracked, size / 1e6))
            del messages[:-4]

    def _detect(self, scene: Scene, snapshot: Snapshot, name: str) -> Boxes:
        frame = observe(scene, lidar_pole(), name, 0, scene_name="road", seed=self._seed, number=snapshot.step)
        points = frame.lidar[LIDAR]
        points = points[self._background[name].in_front(points)]
        found = detect(load_road_network(), points, score_threshold=THRESHOLD)
        return found.transform(frame.world_from_sensor(LIDAR))


def pack_tracks(tracked: Tracked) -> bytes:
    """Return a pole's message to vehicles as bytes: boxes, variances, classes, scores and velocities of its tracks."""
    boxes = tracked.boxes
    arrays = {"boxes": boxes.array(), "category": from_names(boxes.label.tolist()), "velocity": tracked.velocity}
    return pack_arrays({**arrays, "score": np.asarray(boxes.score), "variance": np.asarray(boxes.variance)})


def learn_pole_background(town: Town, pole: str, seed: int) -> Background:
    """Return the static background of a pole's LiDAR, learned from its sweeps of the town without actors."""
    scene = Scene(town, empty_trace(town.name))
    sweeps = [
        observe(scene, lidar_pole(), pole, 0, scene_name="empty", seed=seed, number=number).lidar[LIDAR]
        for number in range(EMPTY_SWEEPS)
    ]
    return learn_background(sweeps)


def merge_detections(own: Boxes, road: Boxes) -> Boxes:
    """Return the vehicle's detections and those of roadside units farther than `SAME_M` from all of them."""
    if not len(road):
        return own
    if len(own):
        away = np.linalg.norm(road.center[:, None, :2] - own.center[None, :, :2], axis=2).min(axis=1)
        road = road[away > SAME_M]
    return concatenate([own, road])
