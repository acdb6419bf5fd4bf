"""Sampling of scenarios from a domain: a place, the weather, and a corner case.

There are three methods: openodd-py's sampler, which draws the least covered buckets first; Latin hypercubes; scrambled
Sobol points (`scipy.stats.qmc`; Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995). A point of the unit
cube has one axis per attribute that recipes set, one for the corner case, and one for the place among those of its
kind. An axis is divided equally among the buckets inside the domain; values are uniform within a bucket, with
visibility on a logarithmic scale.

A sample becomes the recipe of a recording with the corner case at its place and time.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import yaml
from openodd import CoverageReport, OddKnob, OddSampler
from scipy.stats import qmc

from flcav.config import InputError, Json
from flcav.odd.domain import Domain, Value
from flcav.odd.judge import OUTSIDE, choose_rig, find_inside_places, judge_values
from flcav.odd.measure import describe_weather, reach_of
from flcav.odd.scenery import ScenarioPlace, Scenery
from flcav.sensors.rig import RIGS
from flcav.sources.recipe import Recipe, parse_recipe
from flcav.statistics.streams import stream
from flcav.storage.files import flush_all, write_json
from flcav.storage.records import Record
from flcav.world.map.town import PACKAGED
from flcav.world.scenarios.scenario import Kind
from flcav.world.weather import Weather

METHODS = ("coverage", "lhs", "sobol")
CASES: Mapping[str, tuple[Kind, ...]] = {  # possible corner cases by kind of place
    "none": ("stalled_vehicle", "crash", "cut_in", "overtaking", "pedestrian_behind_van"),
    "t_junction": ("stalled_vehicle", "crash", "pedestrian_behind_van", "red_light_runner"),
    "crossroad": ("stalled_vehicle", "crash", "pedestrian_behind_van", "red_light_runner"),
    "roundabout": ("stalled_vehicle", "crash"),
}
LIT: Kind = "red_light_runner"  # only at signalised junctions
CASE = "corner case"  # name of its axis
RAIN_MM_H = 0.3  # least rain rate that needs clouds
RAIN_CLOUDS = 60.0  # least cloud cover with rain [%]
WETTEST_MM_H = 20.0  # rain rate of the greatest wetness
MOST_TRIES = 50  # refused points per recipe before the search is given up
HARDLY = "hardly any weather and place together are inside it"


@dataclass(frozen=True)
class Axis:
    """Sampling axis of an attribute that recipes set: its buckets, as far as they are inside the domain."""

    attribute: str
    labels: tuple[str, ...]  # of the buckets
    spans: tuple[tuple[float, float], ...]  # range of values in each bucket; empty for words
    logarithmic: bool = False

    def at(self, share: float) -> tuple[str, Value]:
        """Return the bucket and the value at a share in [0, 1) of the axis."""
        number, within = divmod(share * len(self.labels), 1.0)
        label = self.labels[int(number)]
        if not self.spans:
            return label, label
        low, high = self.spans[int(number)]
        if self.logarithmic and low > 0:
            return label, float(low * (high / low) ** within)
        return label, float(low + within * (high - low))


@dataclass(frozen=True)
class SampledScenario(Record):
    """A scenario sampled from a domain."""

    place: ScenarioPlace
    case: Kind
    weather: Weather
    buckets: Mapping[str, str]  # bucket by attribute, and the corner case as `CASE`
    rig: str  # name of the vehicles' rig in `RIGS`
    limit_kmh: float  # speed limit on the approach


@dataclass(frozen=True)
class Sampled:
    """Samples of a domain with their pairwise coverage."""

    samples: tuple[SampledScenario, ...]
    pairs: int  # number of pairs of buckets of two axes in the samples
    possible: int  # number of pairs that samples can have
    refused: int  # number of points outside the domain

    @property
    def pairwise(self) -> float:
        """Return the pairwise coverage: the share of the possible pairs of buckets that occur in the samples."""
        return self.pairs / self.possible if self.possible else 1.0


class Space:
    """Sample space of a domain in some towns: its places, rig and axes.

    Raises `InputError` where no place of the towns, no rig, or no value of a recipe's field is inside the domain.
    """

    def __init__(self, domain: Domain, sceneries: Sequence[Scenery]) -> None:
        domain.require_bound()
        self.domain = domain
        self.sceneries = {scenery.town.name: scenery for scenery in sceneries}
        self.places: dict[str, list[tuple[ScenarioPlace, dict[str, Value]]]] = {}
        for place, row in find_inside_places(domain, sceneries):
            if cases_at(place):
                self.places.setdefault(place.kind, []).append((place, row))
        if not self.places:
            towns = ", ".join(scenery.town.name for scenery in sceneries)
            raise InputError(f"{domain.name}: no place of {towns} is inside it; `flcav odd check` says why")
        rig = choose_rig(domain)
        if rig is None:
            raise InputError(f"{domain.name}: no rig of flcav has the field of view and the range that it asks for")
        self.rig, self.reach = rig, reach_of(RIGS[rig])
        self.knobs = domain.knobs()
        self.kinds = next((name for name in self.knobs if domain.bound[name] == "junction"), "")
        self.axes = [self._axis(name, knob) for name, knob in self.knobs.items() if name != self.kinds]
        self.axes.append(Axis(self.kinds, tuple(kind for kind in CASES if kind in self.places), ()))

    def _axis(self, name: str, knob: OddKnob) -> Axis:
        """Return the axis of a number: the buckets within the knob's range, narrowed to values inside the domain."""
        item = next(attribute.item for attribute in self.domain.definition.attributes if attribute.name == name)
        assert item is not None, "knobs are of attributes with buckets"
        limits, reach = self.domain.limits.get(name, ()), knob.reach or (-math.inf, math.inf)
        labels, spans = [], []
        for label, low, high in zip(item.labels, item.edges, item.edges[1:], strict=False):
            low, high = max(low, reach[0]), min(high, reach[1])
            cuts = [low, *(limit for limit in limits if low < limit < high), high]
            parts = [(a, b) for a, b in pairwise(cuts) if b > a and self._is_inside(name, (a + b) / 2)]
            if parts:
                labels.append(label)
                spans.append(max(parts, key=lambda part: part[1] - part[0]))
        if not labels:
            raise InputError(f"{self.domain.name}: no recipe can set {name} inside it")
        return Axis(name, tuple(labels), tuple(spans), self.domain.bound[name] == "visibility")

    def _is_inside(self, name: str, value: float) -> bool:
        """Return whether a value can be inside the domain with what it implies: light by sun, surface by rain."""
        column = self.domain.bound[name]
        weather = {field: np.full(1, np.nan) for field in Weather.model_fields}
        if column == "sun_elevation":
            weather["sun_elevation_deg"][0] = value
        if column == "rainfall":
            weather["rain_mm_h"][0], weather["wetness"][0] = value, wet_by(value)
        implied = {key: one.tolist()[0] for key, one in describe_weather(weather).items()}
        known = {**implied, column: value}
        bound = self.domain.bound.items()
        given = {attribute: known[key] for attribute, key in bound if known.get(key) not in (None, "")}
        return self.domain.can_hold({attribute: one for attribute, one in given.items() if one == one})

    def realise(self, values: Mapping[str, Value], case: float, place: float) -> SampledScenario | None:
        """Return the scenario with these attribute values; None where it is outside the domain.

        `case` and `place` are shares in [0, 1) that choose among the corner cases and places. With rain, a cloud cover
        below `RAIN_CLOUDS` is mapped above it. Attributes that depend on traffic are left open.
        """
        column = {self.domain.bound[name]: value for name, value in values.items()}
        rain = float(column.get("rainfall") or 0.0)
        clouds = float(column.get("cloud_cover") or 0.0)
        if rain >= RAIN_MM_H and clouds < RAIN_CLOUDS:
            clouds = RAIN_CLOUDS + clouds * (100 - RAIN_CLOUDS) / RAIN_CLOUDS
        kind = str(values[self.kinds])
        places = self.places[kind]
        here, row = places[int(place * len(places))]
        cases = cases_at(here)
        chosen = cases[int(case * len(cases))]
        weather = Weather(
            sun_elevation_deg=float(column.get("sun_elevation", 45.0) or 0.0),
            cloud_cover=clouds / 100,
            rain_mm_h=rain,
            visibility_m=float(column.get("visibility") or 20_000.0),
            wetness=wet_by(rain),
        )
        sky = describe_weather({name: np.array([getattr(weather, name)]) for name in Weather.model_fields})
        known = row | {name: value.tolist()[0] for name, value in sky.items()} | self.reach
        if judge_values(self.domain, known) == OUTSIDE:
            return None
        items = {attribute.name: attribute.item for attribute in self.domain.definition.attributes}
        buckets = {
            name: item.bucket_of(known[self.domain.bound[name]])
            for name in self.knobs
            if (item := items[name]) is not None
        }
        return SampledScenario(
            here, chosen, weather, {**buckets, CASE: chosen}, self.rig, float(row["speed_limit"] or 0.0)
        )

    def possible_pairs(self) -> set[tuple[tuple[str, str], tuple[str, str]]]:
        """Return the pairs of buckets of two axes (the corner case is one) that can occur in a sample."""
        cases = {
            kind: {case for place, _ in places for case in cases_at(place)} for kind, places in self.places.items()
        }
        labels = [[(axis.attribute, label) for label in axis.labels] for axis in self.axes]
        labels.append([(CASE, case) for case in dict.fromkeys(c for group in cases.values() for c in sorted(group))])
        tops = {(a.attribute, label): span for a in self.axes for label, span in zip(a.labels, a.spans)}

        def fits(one: tuple[str, str], other: tuple[str, str]) -> bool:
            if one[0] == self.kinds and other[0] == CASE:
                return other[1] in cases[one[1]]
            columns = {self.domain.bound.get(name): tops.get((name, label)) for name, label in (one, other)}
            rain, clouds = columns.get("rainfall"), columns.get("cloud_cover")
            return rain is None or clouds is None or rain[0] < RAIN_MM_H or clouds[1] >= RAIN_CLOUDS

        return {
            (one, other)
            for these, those in combinations(labels, 2)
            for one in these
            for other in those
            if fits(one, other)
        }


def cases_at(place: ScenarioPlace) -> tuple[Kind, ...]:
    """Return the corner cases that are possible at a place."""
    return tuple(case for case in CASES.get(place.kind, ()) if case != LIT or place.control == "signalised")


def wet_by(rain_mm_h: float) -> float:
    """Return the wetness of a road for a rain rate [mm/h]: 0 below `RAIN_MM_H`, 0.95 from `WETTEST_MM_H` on."""
    return 0.0 if rain_mm_h < RAIN_MM_H else 0.3 + 0.65 * min(rain_mm_h / WETTEST_MM_H, 1.0)


def sample_domain(
    space: Space, count: int, method: str, seed: int = 0, covered: CoverageReport | None = None
) -> Sampled:
    """Return `count` samples of a space by a method of `METHODS`.

    `covered` is the coverage of earlier runs, for the method "coverage". Points outside the domain are replaced by
    further ones. Raises `InputError` where hardly any point is inside.
    """
    samples: list[SampledScenario] = []
    refused = 0
    points = (
        _draw_covering(space, count, seed, covered)
        if method == "coverage"
        else draw_sample_points(space, count, method, seed)
    )
    for values, case, place in points:
        sample = space.realise(values, case, place)
        if sample is None:
            refused += 1
            if refused > MOST_TRIES * max(count, 10):
                raise InputError(f"{space.domain.name}: {HARDLY}")
            continue
        samples.append(sample)
        if len(samples) == count:
            break
    return count_pairs(space, samples, refused)


def count_pairs(space: Space, samples: Sequence[SampledScenario], refused: int = 0) -> Sampled:
    """Return samples of a space with their pairwise coverage."""
    possible = space.possible_pairs()
    order = [axis.attribute for axis in space.axes] + [CASE]
    pairs = {
        ((one, sample.buckets[one]), (other, sample.buckets[other]))
        for sample in samples
        for one, other in combinations(order, 2)
    }
    return Sampled(tuple(samples), len(pairs & possible), len(possible), refused)


def draw_sample_points(
    space: Space, count: int, method: str, seed: int
) -> Iterator[tuple[dict[str, Value], float, float]]:
    """Yield values by attribute and the shares in [0, 1) of corner case and place, from endless batches of points."""
    axes, rng = space.axes, stream(seed, "odd", method)
    sobol = qmc.Sobol(len(axes) + 2, scramble=True, rng=rng)
    batch = 1 << max(count - 1, 1).bit_length()  # Sobol points are balanced in powers of two
    while True:
        cube = sobol.random(batch) if method == "sobol" else qmc.LatinHypercube(len(axes) + 2, rng=rng).random(count)
        for row in np.clip(cube, 0.0, np.nextafter(1.0, 0.0)).tolist():
            yield {axis.attribute: axis.at(share)[1] for axis, share in zip(axes, row)}, row[-2], row[-1]


def _draw_covering(
    space: Space, count: int, seed: int, covered: CoverageReport | None
) -> Iterator[tuple[dict[str, Value], float, float]]:
    """Yield points of openodd-py's sampler without end, the least covered buckets first."""
    rng, kinds = stream(seed, "odd", "coverage"), space.axes[-1]
    knobs = {
        name: OddKnob(knob.key, {kind: kind for kind in kinds.labels}) if name == space.kinds else knob
        for name, knob in space.knobs.items()
    }
    drawn = 0
    sampler = OddSampler(
        space.domain.definition, knobs, seed=seed, strategy="coverage", coverage=covered, backend=space.domain.backend
    )
    while True:
        for case in sampler.sample(count) if not drawn else (sampler.draw(drawn + number) for number in range(count)):
            drawn += 1
            yield dict(case.values), float(rng.random()), float(rng.random())


WARMUP_S = 30.0  # of the traffic
BEGINS_S = 31.0  # earliest start of the corner case
SPINS, EVERY_S = 20, 2.0
CAVS = 6  # connected vehicles; the case waits for one to come within 50 m of its place
POLE_M = 40.0  # a pole within this distance of the place also records
INDEX = "samples.json"


def make_recipe(sample: SampledScenario, scenery: Scenery, seed: int, split: str = "train") -> dict[str, Json]:
    """Return the fields of a sample's recipe, as `parse_recipe` reads them."""
    town, place = scenery.town, sample.place
    away = np.linalg.norm(town.poles.position[:, :2] - (place.x, place.y), axis=1)
    near = town.poles.id[np.flatnonzero(away <= POLE_M)[np.argsort(away[away <= POLE_M])][:1]]
    lasts = {"lasts_s": 10.0} if sample.case == "stalled_vehicle" else {}
    position = [round(place.x, 1), round(place.y, 1)]
    return {
        "town": town.name if town.name in PACKAGED else str(town.net.parent.absolute()),
        "seed": seed,
        "split": split,
        "scenes": 1,
        "warmup_s": WARMUP_S,
        "spins_per_scene": SPINS,
        "every_s": EVERY_S,
        "cavs": CAVS,
        "poles": near.tolist(),
        "vehicle_rig": sample.rig,
        "weather": {name: round(float(value), 4) for name, value in sample.weather.model_dump().items()},
        "scenarios": [{"kind": sample.case, "at_s": BEGINS_S, "position": position, **lasts}],
    }


def write_recipes(
    drawn: Sampled,
    sceneries: Mapping[str, Scenery],
    out: Path,
    seed: int,
    also: Callable[[SampledScenario, Recipe, Path], None],
    told: Sequence[Mapping[str, Json]] = (),
) -> list[Path]:
    """Write the recipe of each sample as OUT/NUMBER.yaml, then OUT/samples.json; return the recipes' paths.

    `also` is called for each sample with its recipe and path; `told` has further values of each sample for
    samples.json. All recipes are validated before the first is written. Raises `InputError` where the folder already
    has recipes.
    """
    if out.exists() and any(out.glob("*.yaml")):
        raise InputError(f"{out}: has recipes already; name another folder")
    samples = enumerate(drawn.samples)
    values = [make_recipe(sample, sceneries[sample.place.town], seed + number) for number, sample in samples]
    recipes = [parse_recipe(fields, f"sample {number}") for number, fields in enumerate(values, start=1)]
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"{number:0{len(str(len(values)))}}.yaml" for number in range(1, len(values) + 1)]
    for sample, fields, recipe, path in zip(drawn.samples, values, recipes, paths, strict=True):
        path.write_text(yaml.safe_dump(fields, sort_keys=False, default_flow_style=None))
        also(sample, recipe, path)
    flush_all([*paths, out])
    summary: dict[str, Json] = {
        "pairwise": drawn.pairwise,
        "pairs": drawn.pairs,
        "possible_pairs": drawn.possible,
        "refused": drawn.refused,
        "samples": [
            {"recipe": path.name, **sample.as_json(), **more}
            for path, sample, more in zip(paths, drawn.samples, told or [{}] * len(paths), strict=True)
        ],
    }
    write_json(out / INDEX, summary, sort=False)
    return paths
