"""Adaptive search for failures by Thompson sampling: earlier results determine which scenarios and frames to test.

A naive Bayes model estimates failure rates by bucket of a frame's cell, by corner case and by town. Rates are drawn
from their Beta posteriors (Thompson sampling: Russo et al., "A tutorial on Thompson sampling", 2018), so that rarely
tested buckets are explored. Of a few Sobol points, the scenario with the greatest expected yield in cells without a
failure so far is tested, on the frames of its traffic with the greatest yield. The baselines test as many scenarios and
frames.

A failure is a missed object with many LiDAR returns in the vehicle's path (`cells.locate_failure`). Two failures are
distinct if they lie in different cells of a fixed grid of place, class, weather, traffic, distance and occlusion.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from flcav.config import InputError, Json
from flcav.interface.progress import Report, ignore_progress
from flcav.odd.cells import PATH_AHEAD_M, PATH_ASIDE_M, locate_failure
from flcav.odd.measure import AROUND_M, PARKED
from flcav.odd.sampling import HARDLY, MOST_TRIES, SampledScenario, Space, draw_sample_points, make_recipe
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import find_errors
from flcav.perception.objects.truth import DETECTION_CLASS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import parse_recipe
from flcav.statistics.streams import stream
from flcav.storage.kept import hash_request, keep, read_kept
from flcav.storage.records import Record, from_json, to_json
from flcav.world.trace import Trace
from flcav.world.weather import Weather

SCORE = 0.3  # least score of detections
APART_M = 5.0  # least distance between two tested frames of a vehicle
GRID: Mapping[str, tuple[float, ...]] = {  # edges between the buckets of numbers
    "rainfall": (0.3, 5.0),  # [mm/h]
    "visibility": (400.0, 3000.0),  # [m]
    "agents": (5.0, 15.0, 30.0),  # number of road users not parked within `AROUND_M`
    "distance": (10.0, 20.0, 30.0),  # ahead [m]
    "occlusion": (1 / 3, 2 / 3),
}
CLASSES = tuple(dict.fromkeys(DETECTION_CLASS.values()))
NOBODY = ""  # class of a candidate with an empty path

Cell = tuple[str, ...]  # kind of place, class, and the buckets of the numbers of `GRID`


@dataclass(frozen=True)
class CandidateFrame:
    """A candidate frame of the search: a vehicle at one spin of its LiDAR."""

    spin: int
    vehicle: int  # number of "cav0", ...
    x: float  # of the vehicle, world frame [m]
    y: float  # [m]
    cell: Cell  # of the nearest road user in the path, without occlusion; class `NOBODY` where the path is empty
    away_m: float  # distance to the place of the scenario
    plays: bool  # whether the corner case is in progress


@dataclass(frozen=True)
class Failure(Record):
    """A failure: a missed object in the path of a vehicle."""

    frame: str  # key in the recording of the recipe
    cell: Cell
    distance_m: float  # ahead of the vehicle
    returns: int  # of the LiDAR on the object


@dataclass(frozen=True)
class TriedFrame(Record):
    """A tested frame: the cell of its candidate, and its failures."""

    cell: Cell
    failures: tuple[Failure, ...]


def bucket(name: str, value: float) -> str:
    """Return the bucket of a number of `GRID`."""
    return f"{name} {int(np.digitize(value, GRID[name]))}"


def weather_buckets(weather: Weather) -> tuple[str, str]:
    """Return the buckets of rain and visibility."""
    return bucket("rainfall", weather.rain_mm_h), bucket("visibility", weather.visibility_m)


def list_candidates(sample: SampledScenario, trace: Trace, cavs: int, plays_s: float = 12.0) -> list[CandidateFrame]:
    """Return the candidate frames of the connected vehicles in the traffic of a sample's recipe.

    A corner case lasts `plays_s` [s].
    """
    names = trace.actor.tolist()
    rows = [names.index(f"cav{number}") for number in range(cavs)]
    labels = np.array([DETECTION_CLASS.get(str(category), NOBODY) for category in trace.category])
    driving = ~np.char.startswith(trace.actor, PARKED)
    begins_s = trace.events[0].begins_s if trace.events else np.inf
    candidates = []
    for spin, time_s in enumerate(trace.time_s.tolist()):
        at = np.where(trace.present[spin, :, None], trace.position[spin, :, :2], np.inf)
        for vehicle, row in enumerate(rows):
            here, yaw = at[row], float(trace.yaw[spin, row])
            gap = np.where(np.isfinite(at), at - here, 1e6)
            ahead = gap @ (np.cos(yaw), np.sin(yaw))
            aside = gap @ (-np.sin(yaw), np.cos(yaw))
            path = (ahead > 0) & (ahead <= PATH_AHEAD_M) & (np.abs(aside) <= PATH_ASIDE_M) & (labels != NOBODY)
            path[row] = False
            nearest = int(np.argmin(np.where(path, ahead, np.inf)))
            count = int((driving & (np.hypot(*gap.T) <= AROUND_M)).sum()) - 1
            cell = (
                sample.place.kind,
                str(labels[nearest]) if path.any() else NOBODY,
                *weather_buckets(sample.weather),
                bucket("agents", count),
                bucket("distance", float(ahead[nearest]) if path.any() else np.inf),
            )
            away = float(np.hypot(here[0] - sample.place.x, here[1] - sample.place.y))
            plays = begins_s <= time_s <= begins_s + plays_s
            candidates.append(CandidateFrame(spin, vehicle, float(here[0]), float(here[1]), cell, away, plays))
    return candidates


def take_apart(ranked: Sequence[CandidateFrame], count: int) -> list[CandidateFrame]:
    """Return the first `count` candidates, skipping those within `APART_M` of an earlier one of the same vehicle."""
    taken: list[CandidateFrame] = []
    for one in ranked:
        if all(
            other.vehicle != one.vehicle or np.hypot(other.x - one.x, other.y - one.y) >= APART_M for other in taken
        ):
            taken.append(one)
        if len(taken) == count:
            break
    return taken


def try_frames(
    sample: SampledScenario, source: EmbeddedSource, trace: Trace, chosen: Sequence[CandidateFrame], network: Second
) -> list[TriedFrame]:
    """Render chosen frames of a sample's recording with traffic `trace`, and return a detector's failures in them."""
    scene = source.scenes()[0]
    tested = []
    for candidate in chosen:
        number = candidate.spin * len(source.agents) + candidate.vehicle
        frame = next(source.replay(scene, trace, range(number, number + 1)))
        detections = detect_in(network, [frame], score_threshold=SCORE)
        marks = frame.annotations
        away = np.linalg.norm(marks.boxes.center[:, :2] - frame.world_from_agent[:2, 3], axis=1)
        agents = int((~np.char.startswith(marks.track, PARKED) & (away <= AROUND_M)).sum())
        failures = []
        for error in next(find_errors([frame], detections, network.config, SCORE)):
            ahead = locate_failure(frame.world_from_agent, error)
            if ahead is None:
                continue
            numbers = {"agents": float(agents), "distance": ahead, "occlusion": error.occlusion}
            buckets = (bucket(name, value) for name, value in numbers.items())
            cell = (sample.place.kind, error.label, *weather_buckets(sample.weather), *buckets)
            failures.append(Failure(frame.key, cell, ahead, error.returns))
        tested.append(TriedFrame(candidate.cell, tuple(failures)))
    return tested


RULES = ("sobol", "path", "failures")
TESTED = "tested.jsonl"  # kept results, in the folder of the recipes
FRAMES = 4  # number of tested frames per scenario
POINTS = 8  # number of Sobol points to choose from
PRIOR = 4.0  # weight of the prior of a bucket's rate, in tests
FIRST_RATE = 0.2  # prior mean of the failure rate


@dataclass(frozen=True)
class Searched(Record):
    """A scenario of a search, with its tested frames."""

    sample: SampledScenario
    seed: int  # of its recipe
    tested: tuple[TriedFrame, ...]

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Return the failures of all its frames."""
        return tuple(failure for frame in self.tested for failure in frame.failures)

    @property
    def failed(self) -> Mapping[str, Json]:
        """Return the failures as JSON values."""
        return {"failures": [failure.as_json() for failure in self.failures]}


@dataclass
class FailureModel:
    """A naive Bayes model of failures: counts by bucket, and the cells with failures."""

    tests: Counter[str] = field(default_factory=Counter)  # tested frames by bucket
    hits: Counter[str] = field(default_factory=Counter)  # failing frames by bucket
    failed: Counter[Cell] = field(default_factory=Counter)  # failing frames by cell without occlusion

    def learn(self, sample: SampledScenario, tested: Sequence[TriedFrame]) -> None:
        """Update the counts with the tested frames of a scenario."""
        for frame in tested:
            names = (*frame.cell, *_context(sample), "any")
            self.tests.update(names)
            if frame.failures:
                self.hits.update(names)
            self.failed.update({failure.cell[:-1] for failure in frame.failures})

    def draw_ratios(self, rng: np.random.Generator) -> Mapping[str, float]:
        """Draw failure rates from their posteriors, divided by the mean rate, by bucket; untested ones are missing."""
        mean = (self.hits["any"] + PRIOR * FIRST_RATE) / (self.tests["any"] + PRIOR)
        return {
            name: float(rng.beta(self.hits[name] + PRIOR * mean, count - self.hits[name] + PRIOR * (1 - mean))) / mean
            for name, count in self.tests.items()
        }

    def promise(self, names: Sequence[str], cell: Cell, ratios: Mapping[str, float]) -> float:
        """Return the expected yield of a frame: the product of its ratios, reduced in cells that already failed."""
        rate = float(np.prod([ratios.get(name, 1.0) for name in (*names, *cell)]))
        return rate / (1 + self.failed[cell]) ** 2


def search_failures(
    space: Space,
    network: Second,
    scenarios: int,
    seed: int,
    rule: str = "failures",
    kept: Path | None = None,
    progress: Report = ignore_progress,
) -> list[Searched]:
    """Test a detector in a number of scenarios of a space, `FRAMES` frames each, and return its failures.

    The rule "failures" searches; "sobol" takes Sobol points in order, and the frames nearest to the place during the
    corner case; "path" takes random frames of these points with road users in the path. Scenario n has seed + n. With
    `kept`, a file of JSON lines, results in the file are used again. Raises `InputError` where hardly any Sobol point
    is inside the domain.
    """
    model = FailureModel()
    points = _realise(space, scenarios, seed)
    detector = _hash_weights(network)
    kind = tuple[TriedFrame, ...]
    known = {key: from_json(kind, held, str(kept)) for key, held in read_kept(kept, "tested").items()}
    done: list[Searched] = []
    for number in range(scenarios):
        rng = stream(seed, "odd", rule, str(number))
        few = [next(points) for _ in range(POINTS if rule == "failures" else 1)]
        sample = choose_scenario(few, model, rng)
        key = hash_request([detector, rule, seed, number, sample.as_json()])
        tested = known.get(key)
        if tested is None:
            values = make_recipe(sample, space.sceneries[sample.place.town], seed + number)
            source = EmbeddedSource(parse_recipe(values, f"sample {number}"))
            trace = source.trace(source.scenes()[0])
            candidates = list_candidates(sample, trace, source.recipe.cavs)
            chosen = choose_candidates(candidates, sample, model, rule, rng)
            tested = tuple(try_frames(sample, source, trace, chosen, network))
            keep(kept, key, "tested", to_json(tested, kind))
        model.learn(sample, tested)
        done.append(Searched(sample, seed + number, tested))
        progress(number + 1, scenarios, f"{len(distinct(done))} distinct failures")
    return done


def distinct(searched: Sequence[Searched]) -> set[Cell]:
    """Return the distinct failures: the cells with a failure."""
    return {failure.cell for scenario in searched for failure in scenario.failures}


def choose_scenario(
    samples: Sequence[SampledScenario], model: FailureModel, rng: np.random.Generator
) -> SampledScenario:
    """Return the sample with the greatest expected yield over its cells, by one draw of the rates."""
    ratios = model.draw_ratios(rng)
    agents, distances = ([f"{name} {i}" for i in range(len(GRID[name]) + 1)] for name in ("agents", "distance"))

    def promise(sample: SampledScenario) -> float:
        names, weather = _context(sample), weather_buckets(sample.weather)
        return sum(
            model.promise(names, (sample.place.kind, label, *weather, *rest), ratios)
            for label, *rest in product(CLASSES, agents, distances)
        )

    return max(samples, key=promise)


def choose_candidates(
    every: Sequence[CandidateFrame], sample: SampledScenario, model: FailureModel, rule: str, rng: np.random.Generator
) -> list[CandidateFrame]:
    """Return the frames of a scenario to test, by a rule of `RULES`."""
    near = sorted(every, key=lambda frame: (not frame.plays, frame.away_m))
    if rule == "sobol":
        return take_apart(near, FRAMES)
    path = [frame for frame in near if frame.cell[1] != NOBODY]
    if rule == "path":
        order = rng.permutation(len(path)).tolist()
        return take_apart([path[i] for i in order] + near, FRAMES)
    ratios, names = model.draw_ratios(rng), _context(sample)
    ranked = sorted(path, key=lambda frame: -model.promise(names, frame.cell, ratios))
    firsts = {frame.cell: frame for frame in reversed(ranked)}  # different cells come first
    return take_apart([*(frame for frame in ranked if firsts[frame.cell] is frame), *ranked, *near], FRAMES)


def _context(sample: SampledScenario) -> tuple[str, ...]:
    """Return the features of a scenario that failure rates depend on, in addition to the cell."""
    return f"case {sample.case}", f"town {sample.place.town}"


def _realise(space: Space, scenarios: int, seed: int) -> Iterator[SampledScenario]:
    """Yield the samples of Sobol points inside the domain; raises `InputError` after too many points outside."""
    refused = 0
    for point in draw_sample_points(space, scenarios, "sobol", seed):
        sample = space.realise(*point)
        if sample is not None:
            refused = 0
            yield sample
            continue
        refused += 1
        if refused > 10 * MOST_TRIES:
            raise InputError(f"{space.domain.name}: {HARDLY}")


def _hash_weights(network: Second) -> str:
    whole = hashlib.sha256()
    for value in network.state_dict().values():
        whole.update(value.cpu().numpy().tobytes())
    return whole.hexdigest()
