"""Poses and clocks of vehicles corrected by a pose graph over shared objects and landmarks (GTSAM, extra `fusion`).

Nodes are the poses (x, y, yaw) of vehicles at each spin and those of the reported objects. Factors are the vehicles'
navigation, boxes as poses of objects observed by vehicles and by road sensors, whose poses are surveyed, and posts
segmented from LiDAR as landmarks of known position on the map (Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE
ITS Magazine 2(4), 2010). A post is a thin upright column of returns that stands by itself: a lamp, the mast of a sensor
or a signal, the post of a sign. The Huber kernel bounds the weight of wrong associations.

Clocks are corrected before. A vehicle whose clock is fast reports a moving object where it was a little earlier than
the time stated. Road sensors, whose clocks are exact, observe many of the same objects and the vehicle itself; the
offset is the one at which both agree, by the likelihood over a grid of offsets with a share of outliers. Only moving
objects determine it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import label

from flcav.arrays import Array, Array32
from flcav.config import InputError
from flcav.fusion.average import YAW, Navigation, RoadAverage, Sighting, average_boxes, report_boxes, variance_of
from flcav.geometry import pose, transform_points, wrap_angle, yaw_of
from flcav.interface.wording import format_install_command
from flcav.world.map.town import Town

POST_M = 0.15  # standard deviation of a post's foot
POST_GATE_M = 1.5  # farthest that an observed post may lie from its place on the map
HUBER = 1.345  # where the kernel turns from quadratic to linear [standard deviations]
PASSES = 2  # alternations of association and optimisation


def correct_poses(sightings: Sequence[Sighting], posts: Array, at_s: float) -> list[Sighting]:
    """Return the sightings of a window of spins with the poses and clocks of vehicles corrected.

    posts: (P, 2) x, y of the posts on the map [m]. at_s: time at which objects of different spins are associated [s].
    Sightings of road sensors are unchanged. Raises `InputError` where GTSAM is not installed.
    """
    corrected = list(sightings)
    for _ in range(PASSES):
        corrected = set_clocks(corrected, at_s)
        average = average_boxes([report_boxes(sighting) for sighting in corrected], at_s)
        corrected = _optimise(sightings, corrected, average, posts)
    return corrected


def _optimise(
    stated: Sequence[Sighting], latest: Sequence[Sighting], found: RoadAverage, posts: Array
) -> list[Sighting]:
    """Return the sightings with the poses of the graph's optimum.

    `stated` has the navigation's poses, the priors; `latest` the estimates to associate and start with; `found` the
    objects, posts (P, 2) [m] the landmarks. The objects of each instant are separate nodes, so that nothing is assumed
    about their motion between spins.
    """
    gtsam = _import_gtsam()
    graph = gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    robust = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)

    def noise(variance: Array) -> Any:
        return gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Diagonal.Variances(variance))

    def planar(world_from_agent: Array) -> Any:
        return gtsam.Pose2(*world_from_agent[:2, 3], yaw_of(world_from_agent))

    for number, seen in enumerate(_share_objects(latest, found)):
        key = gtsam.symbol("o", number)
        start.insert(key, gtsam.Pose2(*seen[0].place))
        for observation in seen:
            reported = latest[observation.sighting]
            if reported.navigation is None:
                graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(*observation.place), noise(observation.variance)))
            else:
                relative = planar(reported.world_from_agent).between(gtsam.Pose2(*observation.place))
                vehicle = gtsam.symbol("v", observation.sighting)
                graph.add(gtsam.BetweenFactorPose2(vehicle, key, relative, noise(observation.variance)))
    landmarks = 0
    for number, (first, reported) in enumerate(zip(stated, latest, strict=True)):
        if reported.navigation is None or first.navigation is None:
            continue
        key = gtsam.symbol("v", number)
        start.insert(key, planar(reported.world_from_agent))
        known = first.navigation
        sigmas = np.array((known.position_m, known.position_m, known.heading_rad))
        graph.add(
            gtsam.PriorFactorPose2(
                key, planar(first.world_from_agent), gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-3))
            )
        )
        for observed, place in match_posts(reported, posts):
            point = gtsam.symbol("l", landmarks)
            landmarks += 1
            start.insert(point, place)
            graph.add(gtsam.PriorFactorPoint2(point, place, gtsam.noiseModel.Isotropic.Sigma(2, 0.01)))
            bearing = gtsam.Rot2.fromAngle(np.arctan2(observed[1], observed[0]))
            range_m = float(np.hypot(*observed))
            spread = np.array((POST_M / max(range_m, 1.0), POST_M)) ** 2
            graph.add(gtsam.BearingRangeFactor2D(key, point, bearing, range_m, noise(spread)))
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, best)

    def moved(number: int, reported: Sighting) -> Sighting:
        if reported.navigation is None:
            return reported
        at = best.atPose2(gtsam.symbol("v", number))
        x, y, yaw = np.diag(marginals.marginalCovariance(gtsam.symbol("v", number)))
        known = Navigation(float(np.sqrt((x + y) / 2)), float(np.sqrt(yaw)))
        corrected = pose(at.x(), at.y(), float(reported.world_from_agent[2, 3]), at.theta())
        return replace(reported, world_from_agent=corrected, navigation=known)

    return [moved(number, reported) for number, reported in enumerate(latest)]


def match_posts(reported: Sighting, posts: Array) -> list[tuple[Array, Array]]:
    """Return pairs of a post as observed (2,), agent's frame, and on the map (2,) [m]: each once, nearest first."""
    if not len(reported.posts) or not len(posts):
        return []
    feet = transform_points(
        reported.world_from_agent, np.column_stack((reported.posts, np.zeros(len(reported.posts))))
    )[:, :2]
    apart = np.linalg.norm(feet[:, None] - posts[None], axis=2)
    pairs: list[tuple[Array, Array]] = []
    for flat in np.argsort(apart, axis=None):
        foot, place = divmod(int(flat), len(posts))
        if apart[foot, place] > POST_GATE_M:
            break
        apart[foot, :], apart[:, place] = np.inf, np.inf
        pairs.append((reported.posts[foot], posts[place]))
    return pairs


class _Seen(NamedTuple):
    """An object as one agent observed it, moved to a common instant."""

    sighting: int  # index
    place: Array  # (3,) x, y [m], yaw [rad], world frame by the agent's latest pose
    variance: Array  # (3,) of the box [m^2, m^2, rad^2], without that of the pose


def _share_objects(sightings: Sequence[Sighting], found: RoadAverage) -> list[list[_Seen]]:
    """Return the objects that several agents report at about one instant, as the observations of each.

    The instants are those of the road sensors, or of all agents where there are none. A box is moved to the nearest
    instant by its object's velocity, and turned by 180 degrees where it faces against the object.
    """
    surveyed = [report.time_s for report in sightings if report.navigation is None]
    instants = np.unique(np.round(surveyed or [report.time_s for report in sightings], 3))
    seen: dict[tuple[int, int], list[_Seen]] = {}
    for sighting, (reported, member) in enumerate(zip(sightings, found.member, strict=True)):
        instant = int(np.abs(instants - reported.time_s).argmin())
        rows = reported.boxes.transform(reported.world_from_agent).array()
        variance = variance_of(reported.boxes)
        for box, number in enumerate(member.tolist()):
            place = rows[box, [0, 1, YAW]]
            place[:2] += found.velocity[number] * (instants[instant] - reported.time_s)
            if np.cos(place[2] - found.boxes.yaw[number]) < 0:
                place[2] = wrap_angle(place[2] + np.pi)
            seen.setdefault((number, instant), []).append(_Seen(sighting, place, variance[box, [0, 1, YAW]]))
    return [views for views in seen.values() if len({sightings[view.sighting].agent for view in views}) > 1]


def check_gtsam() -> None:
    """Raise `InputError` where GTSAM is not installed."""
    _import_gtsam()


def _import_gtsam() -> Any:
    try:
        import gtsam
    except ImportError:
        raise InputError(f"a pose graph needs GTSAM, which is in: {format_install_command('fusion')}") from None
    return gtsam


CLOCK_S = 0.3  # standard deviation of an offset, a priori
OFFSETS_S: Array = np.linspace(-0.9, 0.9, 91)  # tried: within three standard deviations
LEAST_SPEED_MPS = 2.0  # slower objects hardly determine clocks
TRACE_M = 0.2  # standard deviation of a path, and of a vehicle's origin from the middle of its body
BEYOND_S = 0.6  # longest extrapolation of a path before its first and after its last instant
OUTLIERS = 0.05  # share of places that belong to no path
LEAST_EVIDENCE = 2.0  # log-likelihood of an offset above that of none: two standard deviations


@dataclass(frozen=True)
class ObjectPath:
    """The path of an object, by road sensors alone."""

    times_s: Array  # (T,) increasing, two or more
    places: Array  # (T, 2) x, y, world frame [m]

    def place_at(self, times_s: Array) -> Array:
        """Return places (..., 2) [m] at times (...) [s], by linear interpolation; infinite beyond `BEYOND_S`."""
        known = self.times_s
        at = np.asarray(times_s)
        before = np.clip(np.searchsorted(known, at) - 1, 0, len(known) - 2)
        share = (at - known[before]) / (known[before + 1] - known[before])
        places = self.places[before] + (self.places[before + 1] - self.places[before]) * share[..., None]
        places[(at < known[0] - BEYOND_S) | (at > known[-1] + BEYOND_S)] = np.inf
        return places


def set_clocks(sightings: Sequence[Sighting], at_s: float) -> list[Sighting]:
    """Return the sightings with vehicles' times on the clock of the road sensors, where these observe them moving.

    at_s: time at which objects of different spins are associated [s]. Times stay as stated where the offset does not
    exceed `LEAST_EVIDENCE` over none.
    """
    traces = trace_objects([sighting for sighting in sightings if sighting.navigation is None], at_s)
    offset = {
        agent: estimate_offset([sighting for sighting in sightings if sighting.agent == agent], traces)
        for agent in {sighting.agent for sighting in sightings if sighting.navigation is not None}
    }
    return [replace(sighting, time_s=sighting.time_s - offset.get(sighting.agent, 0.0)) for sighting in sightings]


def trace_objects(surveyed: Sequence[Sighting], at_s: float) -> list[ObjectPath]:
    """Return the paths of moving objects that road sensors report at two instants or more."""
    by_object: dict[int, dict[float, list[tuple[Array, float]]]] = {}
    reported = [report_boxes(sighting) for sighting in surveyed]
    for report, member in zip(reported, average_boxes(reported, at_s).member, strict=True):
        information = 1 / variance_of(report.boxes)[:, :2].mean(axis=1)
        for number, place, weight in zip(
            member.tolist(), report.boxes.center[:, :2], information.tolist(), strict=True
        ):
            by_object.setdefault(number, {}).setdefault(round(report.time_s, 3), []).append((place, weight))
    traces = []
    for seen in by_object.values():
        times = np.array(sorted(seen))
        places = np.array([_average(seen[time]) for time in times.tolist()])
        if len(times) > 1 and np.linalg.norm(places[-1] - places[0]) >= LEAST_SPEED_MPS * (times[-1] - times[0]):
            traces.append(ObjectPath(times, places))
    return traces


def _average(seen: Sequence[tuple[Array, float]]) -> Array:
    """Return the weighted mean (2,) of places [m]."""
    places, weights = (np.array(column) for column in zip(*seen, strict=True))
    return weights @ places / weights.sum()


def estimate_offset(own: Sequence[Sighting], traces: Sequence[ObjectPath]) -> float:
    """Return the offset by which a vehicle's clock is fast [s]; 0 where `traces` do not determine it.

    own: the vehicle's sightings, with corrected poses or as navigation states them.
    """
    if not traces:
        return 0.0
    evidence = -0.5 * (OFFSETS_S / CLOCK_S) ** 2
    for sighting in own:
        assert sighting.navigation is not None
        boxes = report_boxes(sighting).boxes
        places = np.vstack((boxes.center[:, :2], sighting.world_from_agent[:2, 3]))
        variance = np.append(variance_of(boxes)[:, :2].mean(axis=1), sighting.navigation.position_m**2) + TRACE_M**2
        weight = np.append(np.ones(len(boxes)) if boxes.score is None else boxes.score, 1.0)
        expected = np.stack([trace.place_at(sighting.time_s - OFFSETS_S) for trace in traces])
        apart = np.linalg.norm(places[:, None, None] - expected[None], axis=3).min(axis=1)  # (places, offsets)
        # A mixture of a Gaussian about the nearest path and a uniform share of outliers, which bounds the evidence.
        evidence += weight @ np.log(OUTLIERS + np.exp(-0.5 * apart**2 / variance[:, None]))
    best = int(evidence.argmax())
    return float(OFFSETS_S[best]) if evidence[best] - evidence[len(OFFSETS_S) // 2] > LEAST_EVIDENCE else 0.0


CELL_M = 0.2  # edge of a cell of the bird's-eye grid
BAND_M = (0.5, 2.2)  # heights above the road in which posts are looked for: above kerbs, below the plates of signs
LEAST_M = 0.9  # least height of a column of returns
WIDEST_M = 0.45  # largest extent of a post along x and along y
REACH_M = 40.0  # farther posts have too few returns
LEAST_RETURNS = 4


def segment_posts(points: Array32, height_m: float) -> Array:
    """Return the feet (L, 2) x, y [m] of the posts in a sweep (N, >= 3) [m], in the frame of the points.

    height_m: of the frame's origin above the road [m]. Cells are joined to columns in an 8-neighbourhood.
    """
    z = points[:, 2] + height_m
    near = (z > BAND_M[0]) & (z < BAND_M[1]) & (np.abs(points[:, :2]) < REACH_M).all(axis=1)
    xy = points[near, :2].astype(np.float64)
    z = z[near].astype(np.float64)
    cells = round(2 * REACH_M / CELL_M)
    at = np.minimum(((xy + REACH_M) / CELL_M).astype(np.int64), cells - 1)
    grid = np.zeros((cells, cells), dtype=bool)
    grid[at[:, 0], at[:, 1]] = True
    columns = np.zeros(grid.shape, dtype=np.int64)
    count = int(label(grid, np.ones((3, 3)), output=columns))  # pyright: ignore[reportArgumentType]
    number = columns[at[:, 0], at[:, 1]] - 1
    returns = np.bincount(number, minlength=count)

    def extent(values: Array) -> tuple[Array, Array]:
        low = np.full(count, np.inf)
        high = np.full(count, -np.inf)
        np.minimum.at(low, number, values)
        np.maximum.at(high, number, values)
        return low, high

    (low_x, high_x), (low_y, high_y), (low_z, high_z) = (extent(values) for values in (xy[:, 0], xy[:, 1], z))
    thin = (high_x - low_x <= WIDEST_M) & (high_y - low_y <= WIDEST_M)
    posts = (returns >= LEAST_RETURNS) & thin & (high_z - low_z >= LEAST_M)
    return np.column_stack(((low_x + high_x) / 2, (low_y + high_y) / 2))[posts]


def posts_of(town: Town) -> Array:
    """Return the feet (P, 2) x, y [m] of the posts on a town's map: lamps, masts of sensors and signals, sign posts."""
    parts = (town.lamps[:, :2], town.poles.position[:, :2], town.signs.position[:, :2], town.signals.foot)
    feet = np.concatenate([part.reshape(-1, 2) for part in parts])
    return np.unique(feet, axis=0)
