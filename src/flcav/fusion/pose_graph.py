"""Poses and clocks of vehicles corrected by a pose graph over shared objects and landmarks (GTSAM, extra `fusion`).

Nodes are the poses (x, y, yaw) of vehicles at each spin and those of the objects that agents told of. Factors are the
vehicles' own navigation, boxes as poses of objects seen from vehicles and from road sensors, whose poses are surveyed,
and posts segmented from LiDAR as points that the map knows (Grisetti et al., "A Tutorial on Graph-Based SLAM", IEEE ITS
Magazine 2(4), 2010). The Huber kernel bounds the weight of wrong associations. Before, clocks are set (`clocks.py`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError
from flcav.fusion.average import YAW, RoadAverage, average_boxes, variance_of
from flcav.fusion.clocks import set_clocks
from flcav.fusion.sightings import Navigation, Sighting, tell
from flcav.geometry import pose, transform_points, wrap_angle, yaw_of
from flcav.interface.extras import format_install_command

POST_M = 0.15  # standard deviation of a post's foot
POST_GATE_M = 1.5  # farthest a post may lie from its place on the map, beside the error of the pose
HUBER = 1.345  # where the kernel turns from quadratic to linear [standard deviations]
PASSES = 2  # of association and correction


def correct_poses(sightings: Sequence[Sighting], posts: Array, at_s: float) -> list[Sighting]:
    """Return the sightings of a window of spins with the poses and clocks of vehicles corrected.

    posts: (P, 2) x, y of the posts on the map [m]. Road sensors stay as they are. Raises `InputError` where GTSAM is
    not installed.
    """
    corrected = list(sightings)
    for _ in range(PASSES):
        corrected = set_clocks(corrected, at_s)
        found = average_boxes([tell(each) for each in corrected], at_s)
        corrected = _optimise(sightings, corrected, found, posts)
    return corrected


def _optimise(
    stated: Sequence[Sighting], latest: Sequence[Sighting], found: RoadAverage, posts: Array
) -> list[Sighting]:
    """Return the sightings with the poses of the graph's optimum; `latest` are the estimates to associate and start by.

    The objects of each instant are nodes of their own, so that nothing is assumed about their motion between spins.
    """
    gtsam = _import_gtsam()
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    robust = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)

    def noise(variance: Array) -> Any:
        return gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Diagonal.Variances(variance))

    def planar(world_from_agent: Array) -> Any:
        return gtsam.Pose2(*world_from_agent[:2, 3], yaw_of(world_from_agent))

    for number, seen in enumerate(_share_objects(latest, found)):
        key = gtsam.symbol("o", number)
        start.insert(key, gtsam.Pose2(*seen[0].place))
        for each in seen:
            told = latest[each.sighting]
            if told.navigation is None:
                graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(*each.place), noise(each.variance)))
            else:
                own = planar(told.world_from_agent).between(gtsam.Pose2(*each.place))
                vehicle = gtsam.symbol("v", each.sighting)
                graph.add(gtsam.BetweenFactorPose2(vehicle, key, own, noise(each.variance)))
    landmarks = 0
    for number, (first, told) in enumerate(zip(stated, latest, strict=True)):
        if told.navigation is None or first.navigation is None:
            continue
        key = gtsam.symbol("v", number)
        start.insert(key, planar(told.world_from_agent))
        known = first.navigation
        sigmas = np.array((known.position_m, known.position_m, known.heading_rad))
        graph.add(
            gtsam.PriorFactorPose2(
                key, planar(first.world_from_agent), gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-3))
            )
        )
        for own, place in match_posts(told, posts):
            point = gtsam.symbol("l", landmarks)
            landmarks += 1
            start.insert(point, place)
            graph.add(gtsam.PriorFactorPoint2(point, place, gtsam.noiseModel.Isotropic.Sigma(2, 0.01)))
            bearing, range_m = gtsam.Rot2.fromAngle(np.arctan2(own[1], own[0])), float(np.hypot(*own))
            spread = np.array((POST_M / max(range_m, 1.0), POST_M)) ** 2
            graph.add(gtsam.BearingRangeFactor2D(key, point, bearing, range_m, noise(spread)))
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, best)

    def moved(number: int, told: Sighting) -> Sighting:
        if told.navigation is None:
            return told
        at = best.atPose2(gtsam.symbol("v", number))
        x, y, yaw = np.diag(marginals.marginalCovariance(gtsam.symbol("v", number)))
        known = Navigation(float(np.sqrt((x + y) / 2)), float(np.sqrt(yaw)))
        corrected = pose(at.x(), at.y(), float(told.world_from_agent[2, 3]), at.theta())
        return replace(told, world_from_agent=corrected, navigation=known)

    return [moved(number, told) for number, told in enumerate(latest)]


def match_posts(told: Sighting, posts: Array) -> list[tuple[Array, Array]]:
    """Return pairs of a post as observed (2,), agent's frame, and on the map (2,), each used once, nearest first."""
    if not len(told.posts) or not len(posts):
        return []
    feet = transform_points(told.world_from_agent, np.column_stack((told.posts, np.zeros(len(told.posts)))))[:, :2]
    apart = np.linalg.norm(feet[:, None] - posts[None], axis=2)
    pairs: list[tuple[Array, Array]] = []
    for flat in np.argsort(apart, axis=None):
        foot, place = divmod(int(flat), len(posts))
        if apart[foot, place] > POST_GATE_M:
            break
        apart[foot, :], apart[:, place] = np.inf, np.inf
        pairs.append((told.posts[foot], posts[place]))
    return pairs


class _Seen(NamedTuple):
    """An object as one agent saw it, moved to a common instant."""

    sighting: int
    place: Array  # (3,) x, y, yaw, world frame by the agent's latest pose
    variance: Array  # (3,) of the box, without that of the pose


def _share_objects(sightings: Sequence[Sighting], found: RoadAverage) -> list[list[_Seen]]:
    """Return the objects that several agents tell of at about one instant, each as these agents saw it.

    The instants are those of the road sensors, or of all agents where there are none. A box is moved to the nearest
    instant by its object's velocity, and turned by 180 degrees where it faces against the object.
    """
    surveyed = [each.time_s for each in sightings if each.navigation is None]
    instants = np.unique(np.round(surveyed or [each.time_s for each in sightings], 3))
    seen: dict[tuple[int, int], list[_Seen]] = {}
    for sighting, (told, member) in enumerate(zip(sightings, found.member, strict=True)):
        instant = int(np.abs(instants - told.time_s).argmin())
        rows, variance = told.boxes.transform(told.world_from_agent).array(), variance_of(told.boxes)
        for box, number in enumerate(member.tolist()):
            place = rows[box, [0, 1, YAW]]
            place[:2] += found.velocity[number] * (instants[instant] - told.time_s)
            if np.cos(place[2] - found.boxes.yaw[number]) < 0:
                place[2] = wrap_angle(place[2] + np.pi)
            seen.setdefault((number, instant), []).append(_Seen(sighting, place, variance[box, [0, 1, YAW]]))
    return [each for each in seen.values() if len({sightings[one.sighting].agent for one in each}) > 1]


def check_gtsam() -> None:
    """Raise `InputError` where GTSAM is not installed."""
    _import_gtsam()


def _import_gtsam() -> Any:
    try:
        import gtsam
    except ImportError:
        raise InputError(f"a pose graph needs GTSAM, which is in: {format_install_command('fusion')}") from None
    return gtsam
