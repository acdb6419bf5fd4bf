"""Cooperative awareness messages (CAM, ETSI EN 302 637-2): which vehicles of a trace send them, when, and who hears.

Vulnerable road users' awareness messages (VAM, ETSI TS 103 300-3), which the phones of pedestrians and cyclists send,
follow the same rules with a longer period; the size of a collective perception message (TS 103 324) is here, too.

A message has the fields of the basic container and of the vehicle's containers, in the units and ranges of ETSI TS
102 894-2; `CAM_BITS` lists their bits in unaligned PER. The reference position is the middle of the vehicle's front on
the ground. A message is sent as soon as the vehicle has moved, turned or changed its speed enough, else after a second
(clause 6.1.3; without the shorter period that the rule keeps for three more messages).

A trace has the instants of a recording's spins. Motion between neighbouring spins is interpolated; before the first of
them it continues backwards for the longest period, so that a message precedes every spin.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import CubicHermiteSpline

from flcav.arrays import Array, Ints, Mask, Words
from flcav.config import Config
from flcav.geometry import heading_vectors
from flcav.network.radio import budget as laws
from flcav.network.radio.budget import PathState, Radio, lone_rate_bps, received_dbm
from flcav.network.radio.links import find_sight, vehicle_boxes
from flcav.statistics.streams import stream
from flcav.world.rays.embree import Assembly
from flcav.world.trace import Trace

SENDERS = ("car", "van", "truck", "bus", "motorcycle")  # station types 5, 7, 8, 6, 4
PEOPLE_M = {"pedestrian": (0.8, 0.6), "bicycle": (1.8, 0.6)}  # usual length and width: their messages say none
DRIVING_MPS = 0.5  # vehicles that never drive faster in a trace are parked, and send nothing
STEP_S, SHORTEST_S, LONGEST_S = 0.1, 0.1, 1.0  # grid of times; least and greatest time between two messages
PEOPLE_S = 5.0  # greatest time between two messages of a pedestrian or cyclist
MOVED_M, TURNED_RAD, SPED_MPS = 4.0, np.radians(4.0), 0.5  # changes since the last message that trigger one
GAP_S = 0.5  # longest time between spins through which motion is interpolated
WHITE = 0.2  # share of the position's standard deviation that is drawn for each message; the rest is one draw a drive
SPEED_MPS = 0.1  # standard deviation of announced speeds
POSITION_M = 0.01  # unit of latitude and longitude, 0.1 microdegree, rounded
ELLIPSE = math.sqrt(-2 * math.log(0.05))  # semi-axis of the 95 % ellipse of equal deviations, in standard deviations
WITHIN = 1.96  # half of the 95 % interval of a normal number, in standard deviations
SLOT_S = 0.001  # time on the air in which a message is sent over the whole band, else it is not received

LIGHT_S, CERTIFICATE_S = 0.5, 1.0  # least time between low-frequency containers, and between certificates
PATH_POINTS = 5  # of the path history in a low-frequency container
CAM_BITS = {  # of the message without low-frequency container
    "header: version, kind, station": 8 + 8 + 32,
    "generation time": 16,
    "optional and extensible parts": 1 + 2 + 1 + 1 + 1 + 7,
    "station type": 8,
    "latitude, longitude": 31 + 32,
    "confidence ellipse: semi-axes, orientation": 12 + 12 + 12,
    "altitude, its confidence": 20 + 4,
    "heading, its confidence": 12 + 7,
    "speed, its confidence": 14 + 7,
    "drive direction": 2,
    "length, trailer": 10 + 3,
    "width": 6,
    "longitudinal acceleration, its confidence": 9 + 7,
    "curvature, its confidence, how it was computed": 11 + 3 + 1 + 2,
    "yaw rate, its confidence": 16 + 4,
}
VAM_BITS = {  # of a pedestrian's or cyclist's message; its profile, due every two seconds, is in each
    "header: version, kind, station": 8 + 8 + 32,
    "generation time": 16,
    "optional and extensible parts": 1 + 4 + 1 + 1 + 11 + 1 + 2,
    "station type": 8,
    "latitude, longitude": 31 + 32,
    "confidence ellipse: semi-axes, orientation": 12 + 12 + 12,
    "altitude, its confidence": 20 + 4,
    "heading, its confidence": 12 + 7,
    "speed, its confidence": 14 + 7,
    "longitudinal acceleration, its confidence": 9 + 7,
    "profile": 1 + 2 + 3,
}
LIGHT_BITS = 1 + 4 + 8 + 6 + PATH_POINTS * (1 + 18 + 18 + 15 + 1 + 16)  # role, lights, path of points with their times
CPM_BITS = {  # of a collective perception message without objects: TS 103 324, of a vehicle
    "header: version, kind, station": 8 + 8 + 32,
    "optional and extensible parts": 1 + 1 + 2 + 1 + 3,
    "reference time": 42,
    "reference position": 31 + 32 + 36 + 24,
    "container of the vehicle: number, length, heading and its confidence": 4 + 8 + 24,
    "container of objects: number, length, counts": 4 + 16 + 8 + 9,
}
OBJECT_BITS = {  # of each of its objects
    "optional and extensible parts": 1 + 14,
    "number, time": 16 + 12,
    "position with confidences": 1 + 3 * (18 + 12),
    "velocity with confidences": 1 + 1 + 2 * (15 + 7),
    "heading with confidence": 2 + 12 + 7,
    "three dimensions with confidences": 3 * (8 + 5),
    "age, quality": 11 + 4,
    "class with confidence": 1 + 3 + 1 + 2 + 8 + 7,
}
TRANSPORT_BYTES = 4 + 4 + 8 + 28  # BTP-B, and GeoNetworking headers of a single hop: EN 302 636-5-1 and 636-4-1
SIGNED_BYTES = 95  # of TS 103 097 around a message: payload's header 19, digest 10, ECDSA P-256 signature 66
CERTIFICATE_BYTES = (
    131  # more where the certificate, an authorisation ticket of some 140 bytes, is in place of a digest
)


class MessageSettings(Config):
    """Awareness messages of connected vehicles: who sends them, how accurate they are, and the radio."""

    share: float = Field(default=0.3, ge=0, le=1)  # of the vehicles that drive, drawn vehicle by vehicle
    position_m: float = Field(
        default=0.5, ge=0, le=10
    )  # standard deviation of announced positions, along x and along y; nearly all of it is one draw for each drive
    heading_deg: float = Field(default=0.5, ge=0, le=45)  # standard deviation of announced headings
    people: float = Field(default=0.0, ge=0, le=1)  # share of pedestrians and cyclists whose phones announce them
    people_m: float = Field(default=2.0, ge=0, le=10)  # standard deviation of a phone's positions, along x and along y
    perceived: bool = True  # whether those that record also send what they detect (TS 103 324)
    lost: float = Field(default=0.0, ge=0, le=1)  # share of messages lost to others on the air
    radio: Radio = Radio()  # of both ends


@dataclass(frozen=True)
class AwarenessMessages:
    """N messages, in SI units after quantisation, by time within each sender."""

    sender: Ints  # (N,) actor of the trace
    time_s: Array  # (N,) of its generation
    front: Array  # (N, 2) middle of the vehicle's front [m, world]
    deviation_m: Array  # (N,) standard deviation along each axis, by the stated ellipse
    heading: Array  # (N,) [rad]
    turn_rad: Array  # (N,) standard deviation of the heading, by its stated confidence of 95 %
    speed: Array  # (N,) [m/s]
    size: Array  # (N, 2) length and width [m]
    bytes: Ints  # (N,) with security and transport

    def __len__(self) -> int:
        return len(self.sender)

    def __getitem__(self, rows: Ints | Mask) -> "AwarenessMessages":
        return AwarenessMessages(*(values[rows] for values in vars(self).values()))


def draw_connected(trace: Trace, how: MessageSettings, *names: str) -> Ints:
    """Return the actors of a trace that send messages: vehicles that drive, and pedestrians and cyclists.

    Each does with the probability `share`, or `people`. `names` and the actor's name the random stream, so that a
    larger share adds senders to those of a smaller one.
    """
    fastest = np.linalg.norm(np.nan_to_num(trace.velocity), axis=2).max(axis=0, initial=0.0)
    drives = np.isin(trace.category, SENDERS) & (fastest > DRIVING_MPS)
    share = np.where(is_person(trace.category), how.people, np.where(drives, how.share, 0.0))
    able = np.flatnonzero(share > 0)
    drawn = [stream(0, "connected", *names, str(trace.actor[row])).random() < share[row] for row in able]
    return able[np.array(drawn, dtype=bool)]


def is_person(category: Words) -> Mask:
    """Return (N,) which actors are pedestrians or cyclists, by their categories."""
    return np.isin(category, list(PEOPLE_M))


def send_messages(trace: Trace, senders: Sequence[int] | Ints, how: MessageSettings, *names: str) -> AwarenessMessages:
    """Return all messages of the `senders`, actors of a trace; `names` name the random streams of their errors."""
    rows = [message for sender in senders for message in _messages_of(trace, int(sender), how, names)]
    told = np.array(rows, dtype=np.float64).reshape(-1, 11)
    numbers = told[:, (0, 10)].astype(np.int64)
    deviation_m, heading, turn_rad, speed = told[:, 4:8].T
    front, size, count = told[:, 2:4], told[:, 8:10], numbers[:, 1]
    return AwarenessMessages(numbers[:, 0], told[:, 1], front, deviation_m, heading, turn_rad, speed, size, count)


def _messages_of(trace: Trace, sender: int, how: MessageSettings, names: Sequence[str]) -> Iterator[tuple[float, ...]]:
    """Yield the eleven numbers of each message of a sender, in the order of the fields of `AwarenessMessages`."""
    name, category = str(trace.actor[sender]), str(trace.category[sender])
    person = category in PEOPLE_M
    longest_s, off_m = (PEOPLE_S, how.people_m) if person else (LONGEST_S, how.position_m)
    rng, bias, stated_m = stream(0, "announced", *names, name), draw_bias(off_m, *names, name), state_deviation(off_m)
    turn_rad = np.radians(min(max(math.ceil(10 * WITHIN * how.heading_deg), 1), 125) / 10 / WITHIN)
    size = np.array(PEOPLE_M[category]) if person else np.ceil(trace.size[sender, :2] * 10 - 1e-6) / 10
    for times_s, place, yaw, speed in _pieces(trace, sender, longest_s):
        first = int(rng.integers(round(longest_s / STEP_S)))
        sent = find_sending_times(times_s, place, yaw, speed, first, longest_s)
        light_s = certified_s = -np.inf
        for row in sent:
            light, certified = times_s[row] - light_s >= LIGHT_S, times_s[row] - certified_s >= CERTIFICATE_S
            light_s, certified_s = (times_s[row] if light else light_s), (times_s[row] if certified else certified_s)
            off = bias + off_m * WHITE * rng.standard_normal(2)
            front = place[row] + heading_vectors(yaw[row]) * (size if person else trace.size[sender])[0] / 2 + off
            told = np.degrees(yaw[row]) + how.heading_deg * rng.standard_normal()
            fast = max(speed[row] + SPEED_MPS * rng.standard_normal(), 0.0)
            yield (
                *(sender, times_s[row], *np.round(front / POSITION_M) * POSITION_M, stated_m),
                *(np.radians(round(told * 10) / 10), turn_rad, round(min(fast, 163.82) * 100) / 100, *size),
                message_bytes(light=bool(light), certified=bool(certified), person=person),
            )


def draw_bias(position_m: float, *names: str) -> Array:
    """Return the constant part (2,) [m] of the position error of a drive; `names` end with the sender's."""
    return position_m * math.sqrt(1 - WHITE**2) * stream(0, "bias", *names).standard_normal(2)


def state_deviation(position_m: float) -> float:
    """Return the standard deviation [m] that the stated confidence ellipse stands for, in centimetres rounded up."""
    return min(max(math.ceil(100 * ELLIPSE * position_m), 1), 4094) / 100 / ELLIPSE


def message_bytes(*, light: bool, certified: bool, person: bool = False) -> int:
    """Return the bytes of a message on the air, with or without low-frequency container and certificate.

    person: of a pedestrian or cyclist, whose messages have no such container.

    >>> message_bytes(light=False, certified=False), message_bytes(light=True, certified=True)
    (180, 356)
    """
    bits = sum(VAM_BITS.values()) if person else sum(CAM_BITS.values()) + light * LIGHT_BITS
    return math.ceil(bits / 8) + TRANSPORT_BYTES + SIGNED_BYTES + certified * CERTIFICATE_BYTES


def perception_bytes(objects: int) -> int:
    """Return the bytes on the air of a collective perception message with so many objects.

    >>> perception_bytes(0), perception_bytes(10)
    (177, 523)
    """
    bits = sum(CPM_BITS.values()) + objects * sum(OBJECT_BITS.values())
    return math.ceil(bits / 8) + TRANSPORT_BYTES + SIGNED_BYTES


def _pieces(trace: Trace, actor: int, lead_s: float) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Yield times (N,) [s], centres (N, 2) [m], headings (N,) [rad] and speeds (N,) [m/s] on the grid of `STEP_S`.

    A piece is of neighbouring spins in which the actor is present, and of `lead_s` before them.
    """
    here = np.flatnonzero(trace.present[:, actor])
    for piece in np.split(here, np.flatnonzero(np.diff(trace.time_s[here]) > GAP_S) + 1) if len(here) else ():
        known_s, xy, velocity = trace.time_s[piece], trace.position[piece, actor, :2], trace.velocity[piece, actor, :2]
        lead = round(lead_s / STEP_S)
        times_s = known_s[0] + np.arange(-lead, round((known_s[-1] - known_s[0]) / STEP_S) + 1) * STEP_S
        before_s = np.minimum(times_s - known_s[0], 0.0)
        if len(piece) == 1:
            place, motion = np.tile(xy, (len(times_s), 1)), np.tile(velocity, (len(times_s), 1))
        else:
            path = CubicHermiteSpline(known_s, xy, velocity)
            place, motion = path(times_s - before_s), path(times_s - before_s, 1)
        place = place + before_s[:, None] * velocity[0]
        yaw = np.interp(times_s, known_s, np.unwrap(trace.yaw[piece, actor]))
        yield times_s, place, yaw, np.linalg.norm(motion, axis=1)


def find_sending_times(
    times_s: Array, place: Array, yaw: Array, speed: Array, first: int, longest_s: float = LONGEST_S
) -> list[int]:
    """Return the rows of a motion at which a message is sent: at `first`, then by the rules of generation.

    Two messages are at most `longest_s` apart.

    times_s: (N,) ascending [s]; place: (N, 2) [m]; yaw: (N,) unwrapped [rad]; speed: (N,) [m/s].
    """
    sent = [first] if first < len(times_s) else []
    for row in range(first + 1, len(times_s)):
        last = sent[-1]
        changed = (
            np.hypot(*(place[row] - place[last])) > MOVED_M
            or abs(yaw[row] - yaw[last]) > TURNED_RAD
            or abs(speed[row] - speed[last]) > SPED_MPS
        )
        since_s = times_s[row] - times_s[last] + 1e-6
        if since_s >= (SHORTEST_S if changed else longest_s):
            sent.append(row)
    return sent


def find_received(
    messages: AwarenessMessages, trace: Trace, receiver: str, walls: Assembly | None, how: MessageSettings, *names: str
) -> Mask:
    """Return (N,) which messages a vehicle of the trace receives.

    A link is as good as at the nearest spin. A message is received where the link carries it within `SLOT_S`, and then
    unless it is among the share that is `lost`. walls: the buildings in the path, None without any. `names` name the
    random streams of shadowing and blockage, one draw for each sender, and of losses.
    """
    received, radio = np.zeros(len(messages), np.bool_), how.radio
    own = trace.actor.tolist().index(receiver)
    nearest = np.abs(messages.time_s[:, None] - trace.time_s).argmin(axis=1)
    antenna = trace.position + trace.size * (0.0, 0.0, 1.0)  # (T, A, 3)
    for instant in np.unique(nearest).tolist():
        if not trace.present[instant, own]:
            continue
        heard = (messages.sender != own) & trace.present[instant, messages.sender]
        rows = np.flatnonzero((nearest == instant) & heard)
        boxes, actor = vehicle_boxes(trace, instant)
        boxes, actor = boxes[actor != own], actor[actor != own]
        carrier = np.full(len(trace.actor), -1, np.int64)
        carrier[actor] = np.arange(len(actor))
        senders = messages.sender[rows]
        sight = find_sight(antenna[instant, senders], antenna[instant, own][None], walls, boxes, carrier[senders])
        loss_db = _losses_db(trace, instant, senders, own, sight.state[:, 0], sight.blocker[:, 0], actor, radio, names)
        rate_bps = lone_rate_bps(received_dbm(loss_db, radio), radio)
        received[rows] = rate_bps * SLOT_S >= 8 * messages.bytes[rows]
    return received & (stream(0, "lost", *names, receiver).random(len(messages)) >= how.lost)


def _losses_db(
    trace: Trace,
    instant: int,
    senders: Ints,
    own: int,
    state: NDArray[np.int8],
    blocker: Ints,
    actor: Ints,
    radio: Radio,
    names: Sequence[str],
) -> Array:
    """Return the losses (N,) [dB] between the roofs of `senders` (N,) and of the actor `own` at an instant."""
    top = trace.position[instant, :, 2] + trace.size[:, 2]
    tips = np.column_stack((trace.position[instant, :, :2], top))
    distance = np.linalg.norm(tips[senders] - tips[own], axis=1)
    pair = [(str(trace.actor[sender]), str(trace.actor[own])) for sender in senders]
    draws = np.array([stream(0, "shadowing", *names, *ends).standard_normal(2) for ends in pair]).reshape(-1, 2)
    over = top[np.append(actor, own)[blocker]]  # of no blocker any: it is not used
    lower, higher = np.minimum(top[senders], top[own]), np.maximum(top[senders], top[own])
    blocked = np.where(state == PathState.NLOSV, laws.blockage_db(distance, lower, higher, over, draws[:, 1]), 0.0)
    shadow = laws.shadowing_sigma_db(state, radio.environment) * draws[:, 0] * radio.shadowing
    return laws.path_loss_db(distance, state, radio.frequency_ghz, radio.environment) + blocked + shadow
