"""Sampling of a domain: where a recipe is set, in what weather, and which corner case happens there.

Three ways to draw: openodd-py's sampler, least covered buckets first; Latin hypercubes; scrambled Sobol points
(`scipy.stats.qmc`; Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995). A point of the unit cube has one
axis per attribute that recipes set, one for the corner case and one for the place among those of its kind. An axis goes
over the buckets inside the domain, equally, and within a bucket uniformly; sight on a logarithmic scale.

A sample becomes the recipe of a recording, with its corner case where and when it is to happen.
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
CASES: Mapping[str, tuple[Kind, ...]] = {  # corner cases that a kind of place lends itself to
    "none": ("stalled_vehicle", "crash", "cut_in", "overtaking", "pedestrian_behind_van"),
    "t_junction": ("stalled_vehicle", "crash", "pedestrian_behind_van", "red_light_runner"),
    "crossroad": ("stalled_vehicle", "crash", "pedestrian_behind_van", "red_light_runner"),
    "roundabout": ("stalled_vehicle", "crash"),
}
LIT: Kind = "red_light_runner"  # happens at signalised junctions alone
CASE = "corner case"  # name of its axis
RAIN_MM_H, RAIN_CLOUDS = 0.3, 60.0  # rain from there on needs clouds of that share [%]
WETTEST_MM_H = 20.0  # rain rate at which the road is as wet as rain makes it
MOST_TRIES = 50  # points per recipe before the domain is taken to have none
HARDLY = "hardly any weather and place together are inside it"


@dataclass(frozen=True)
class Axis:
    """An attribute that recipes set: the part of its buckets inside the domain that can be set."""

    attribute: str
    labels: tuple[str, ...]
    spans: tuple[tuple[float, float], ...]  # of each bucket; of words empty
    logarithmic: bool = False

    def at(self, share: float) -> tuple[str, Value]:
        """Return bucket and value at a share in [0, 1) of the axis."""
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
    """One drawn scenario of a domain."""

    place: ScenarioPlace
    case: Kind
    weather: Weather
    buckets: Mapping[str, str]  # attribute, and the corner case -> bucket
    rig: str  # of vehicles, a name of `RIGS`
    limit_kmh: float  # speed limit on the approach


@dataclass(frozen=True)
class Sampled:
    """Samples of a domain, and the pairs of buckets that they have."""

    samples: tuple[SampledScenario, ...]
    pairs: int  # pairs of buckets of two axes in the samples
    possible: int  # pairs that a sample can have
    refused: int  # points that were outside the domain

    @property
    def pairwise(self) -> float:
        """Return the pairwise coverage: the share of possible pairs that the samples have."""
        return self.pairs / self.possible if self.possible else 1.0


class Space:
    """What can be sampled of a domain in some towns.

    Raises `InputError` where no place of the towns, no rig or no value of a field is inside it.
    """

    def __init__(self, domain: Domain, sceneries: Sequence[Scenery]) -> None:
        domain.require_bound()
        self.domain, self.sceneries = domain, {scenery.town.name: scenery for scenery in sceneries}
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
        """Return the axis of a number: the buckets that the knob reaches, as far as values in them are inside."""
        item = next(each.item for each in self.domain.definition.attributes if each.name == name)
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
        """Return whether a value can be inside the domain, with its implications: light by sun, surface by rain."""
        column = self.domain.bound[name]
        weather = {field: np.full(1, np.nan) for field in Weather.model_fields}
        if column == "sun_elevation":
            weather["sun_elevation_deg"][0] = value
        if column == "rainfall":
            weather["rain_mm_h"][0], weather["wetness"][0] = value, wet_by(value)
        implied = {key: one.tolist()[0] for key, one in describe_weather(weather).items()}
        known = {**implied, column: value}
        given = {each: known[own] for each, own in self.domain.bound.items() if known.get(own) not in (None, "")}
        return self.domain.can_hold({each: one for each, one in given.items() if one == one})

    def realise(self, values: Mapping[str, Value], case: float, place: float) -> SampledScenario | None:
        """Return the sample with these values, shares in [0, 1) of its cases and places; None if it cannot be.

        Where it rains, fewer clouds than `RAIN_CLOUDS` are lifted above it. A sample is refused where the domain is
        outside, with what traffic decides left open.
        """
        column = {self.domain.bound[name]: value for name, value in values.items()}
        rain, clouds = float(column.get("rainfall") or 0.0), float(column.get("cloud_cover") or 0.0)
        if rain >= RAIN_MM_H and clouds < RAIN_CLOUDS:
            clouds = RAIN_CLOUDS + clouds * (100 - RAIN_CLOUDS) / RAIN_CLOUDS
        kind = str(values[self.kinds])
        every = self.places[kind]
        here, row = every[int(place * len(every))]
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
        items = {each.name: each.item for each in self.domain.definition.attributes}
        buckets = {
            name: item.bucket_of(known[self.domain.bound[name]])
            for name in self.knobs
            if (item := items[name]) is not None
        }
        return SampledScenario(
            here, chosen, weather, {**buckets, CASE: chosen}, self.rig, float(row["speed_limit"] or 0.0)
        )

    def possible_pairs(self) -> set[tuple[tuple[str, str], tuple[str, str]]]:
        """Return the pairs of buckets, of two axes or of an axis and the corner cases, that a sample can have."""
        cases = {
            kind: {case for place, _ in places for case in cases_at(place)} for kind, places in self.places.items()
        }
        own = [[(axis.attribute, label) for label in axis.labels] for axis in self.axes]
        own.append([(CASE, case) for case in dict.fromkeys(each for every in cases.values() for each in sorted(every))])
        tops = {(a.attribute, label): span for a in self.axes for label, span in zip(a.labels, a.spans)}

        def fits(one: tuple[str, str], other: tuple[str, str]) -> bool:
            if one[0] == self.kinds and other[0] == CASE:
                return other[1] in cases[one[1]]
            columns = {self.domain.bound.get(name): tops.get((name, label)) for name, label in (one, other)}
            rain, clouds = columns.get("rainfall"), columns.get("cloud_cover")
            return rain is None or clouds is None or rain[0] < RAIN_MM_H or clouds[1] >= RAIN_CLOUDS

        return {
            (one, other)
            for these, those in combinations(own, 2)
            for one in these
            for other in those
            if fits(one, other)
        }


def cases_at(place: ScenarioPlace) -> tuple[Kind, ...]:
    """Return the corner cases that can happen at a place."""
    return tuple(case for case in CASES.get(place.kind, ()) if case != LIT or place.control == "signalised")


def wet_by(rain_mm_h: float) -> float:
    """Return the wetness of a road in the rain: none in a drizzle, up to .95 from `WETTEST_MM_H` on."""
    return 0.0 if rain_mm_h < RAIN_MM_H else 0.3 + 0.65 * min(rain_mm_h / WETTEST_MM_H, 1.0)


def sample_domain(
    space: Space, count: int, method: str, seed: int = 0, covered: CoverageReport | None = None
) -> Sampled:
    """Return `count` samples of a space.

    covered: report of earlier runs, of the method "coverage". Points that are refused are replaced by further ones.
    Raises `InputError` where hardly any point can be realised.
    """
    samples: list[SampledScenario] = []
    refused = 0
    points = (
        _draw_covering(space, count, seed, covered)
        if method == "coverage"
        else draw_sample_points(space, count, method, seed)
    )
    for values, case, place in points:
        found = space.realise(values, case, place)
        if found is None:
            refused += 1
            if refused > MOST_TRIES * max(count, 10):
                raise InputError(f"{space.domain.name}: {HARDLY}")
            continue
        samples.append(found)
        if len(samples) == count:
            break
    return count_pairs(space, samples, refused)


def count_pairs(space: Space, samples: Sequence[SampledScenario], refused: int = 0) -> Sampled:
    """Return samples of a space with the pairs of buckets that they have."""
    possible = space.possible_pairs()
    order = [axis.attribute for axis in space.axes] + [CASE]
    had = {
        ((one, each.buckets[one]), (other, each.buckets[other]))
        for each in samples
        for one, other in combinations(order, 2)
    }
    return Sampled(tuple(samples), len(had & possible), len(possible), refused)


def draw_sample_points(
    space: Space, count: int, method: str, seed: int
) -> Iterator[tuple[dict[str, Value], float, float]]:
    """Yield values by attribute and the shares of case and place, without end, in batches of quasi-random points."""
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
    """Yield points of openodd-py's sampler, the least covered buckets first, without end."""
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


WARMUP_S, BEGINS_S = 30.0, 31.0  # of the traffic; from then on the corner case may begin
SPINS, EVERY_S = 20, 2.0
CAVS = 6  # the case waits for one of them to come within 50 m of its place
POLE_M = 40.0  # a pole this near to the place records, too
INDEX = "samples.json"


def make_recipe(sample: SampledScenario, scenery: Scenery, seed: int, split: str = "train") -> dict[str, Json]:
    """Return the fields of the recipe of a sample, which `parse_recipe` takes."""
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
    """Write the recipe of each sample as OUT/NUMBER.yaml, and OUT/samples.json last; return the recipes' paths.

    also: called for each sample with its recipe and path; told: further values of each sample in samples.json. Every
    recipe has been read before it is written. Raises `InputError` where the folder has recipes already.
    """
    if out.exists() and any(out.glob("*.yaml")):
        raise InputError(f"{out}: has recipes already; name another folder")
    values = [make_recipe(each, sceneries[each.place.town], seed + number) for number, each in enumerate(drawn.samples)]
    recipes = [parse_recipe(each, f"sample {number}") for number, each in enumerate(values, start=1)]
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"{number:0{len(str(len(values)))}}.yaml" for number in range(1, len(values) + 1)]
    for sample, each, recipe, path in zip(drawn.samples, values, recipes, paths, strict=True):
        path.write_text(yaml.safe_dump(each, sort_keys=False, default_flow_style=None))
        also(sample, recipe, path)
    flush_all([*paths, out])
    summary: dict[str, Json] = {
        "pairwise": drawn.pairwise,
        "pairs": drawn.pairs,
        "possible_pairs": drawn.possible,
        "refused": drawn.refused,
        "samples": [
            {"recipe": path.name, **each.as_json(), **more}
            for path, each, more in zip(paths, drawn.samples, told or [{}] * len(paths), strict=True)
        ],
    }
    write_json(out / INDEX, summary, sort=False)
    return paths
