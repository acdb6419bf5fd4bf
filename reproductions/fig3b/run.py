"""Fig. 3b of Wang et al. (IEEE Network 37(3), 2023): where a detector errs in a town, and which pole gets the sensor.

Vehicles drive through `grid` with the detector of the package. Its errors are counted in zones around the candidate
poles; the pole that covers most errors is compared with conventional placements, by visible objects and by traffic.
The same number of drives in each of three other towns shows how many sensors those need.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.interface.progress import Report, ignore_progress
from flcav.optimization.placement.baselines import place_by_score
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import TIE
from flcav.optimization.placement.solve import Candidates, Placement, find_candidates, place_count
from flcav.perception.errors import Registry
from flcav.perception.networks import resolve_network
from flcav.perception.objects.task import OBJECTS
from flcav.report import style
from flcav.report.charts.figures import town_map
from flcav.report.charts.placement import draw_cover
from flcav.report.pictures.maps import DENSEST, MOST_VISIBLE, ErrorMap, poles_of
from flcav.runs.provenance import Provenance, provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.line_of_sight import count_visible_actors, find_viewshed
from flcav.world.map.census import measure_traffic_density
from flcav.world.map.town import Town

ASKED = (0.25, 0.5, 0.75)  # shares of the errors to cover
REACHED = (0.5, 0.75, 0.9)  # shares of the errors in reach of any pole


@dataclass(frozen=True)
class TownCover:
    """Errors in a town, and the shares of them that sensors on its poles cover."""

    town: str
    errors: int
    poles: int  # candidates
    shares: tuple[float, ...]  # of the errors: the largest that 1, 2, ... sensors on different poles cover
    wanted: tuple[int | None, ...]  # fewest sensors for each of `ASKED`; None where all poles cover less
    kinds: Mapping[str, float]  # by kind of scenario, mean number of errors within range of a candidate pole of it

    def count_for_reached(self, share: float) -> int:
        """Return the fewest sensors for a share of the errors that sensors on all poles together cover."""
        return 1 + next(n for n, covered in enumerate(self.shares) if covered >= share * self.shares[-1] * (1 - TIE))


def cover_town(town: Town, errors: NDArray[np.float64], range_m: float) -> TownCover:
    """Return the cover of the errors (E, 3), world frame [m], by sensors of range `range_m` on candidate poles."""
    candidates = find_candidates(errors, town.poles.position, [range_m]).at_unit_cost()
    poles = len(town.poles.id)
    shares = tuple(place_count(candidates, count).covered / len(errors) for count in range(1, poles + 1))
    within = candidates.covers.sum(axis=1)
    kinds = sorted(set(town.poles.kind))
    return TownCover(
        town=town.name,
        errors=len(errors),
        poles=poles,
        shares=shares,
        wanted=tuple(len(cover_share(candidates, share)[0].chosen) if share <= shares[-1] else None for share in ASKED),
        kinds={kind: float(np.mean(within[np.asarray(town.poles.kind) == kind])) for kind in kinds},
    )


def list_kinds(towns: Sequence[TownCover]) -> list[str]:
    """Return the kinds of scenarios of all towns, in ascending order of the errors around a pole."""
    kinds = {kind for town in towns for kind in town.kinds}
    return sorted(kinds, key=lambda kind: float(np.mean([town.kinds[kind] for town in towns if kind in town.kinds])))


RECIPE: Mapping[str, Any] = {
    "town": "grid",
    "seed": 8311,
    "split": "registry",
    "scenes": 8,
    "spins_per_scene": 4,
    "every_s": 4.0,
    "cavs": 4,
    "vehicle_rig": "kitti_lidar",
}
OTHERS: Mapping[str, int] = {"ring": 8312, "suburb": 8313, "arterial": 8314}  # towns compared, and their seeds
RANGE_M = 40.0  # within which a sensor covers an error
ZONE_M = 30.0  # radius of a scenario zone around a candidate pole
COUNTS = (1, 2, 3)  # sensors


@dataclass(frozen=True)
class Zone:
    """The errors around one candidate pole."""

    pole: int
    kind: str  # straight, cross, tee or roundabout
    errors: int
    per_hectare: float
    per_frame: float | None  # errors per vehicle frame taken in the zone; None without any
    actors: float  # mean number of actors within `RANGE_M`


@dataclass(frozen=True)
class ChosenPoles:
    """The poles that one rule chooses, and the errors they cover."""

    rule: str
    count: int
    poles: tuple[int, ...]
    covered: int


@dataclass(frozen=True)
class Fig3b(Record):
    """Errors by zone, and placements for 1, 2 and 3 sensors."""

    frames: int
    errors: int
    zones: tuple[Zone, ...]  # densest in errors first
    placed: tuple[ChosenPoles, ...]
    towns: tuple[TownCover, ...]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return zones and placements in words."""
        first = self.zones[0]
        sentences = [
            f"{self.errors} errors in {self.frames} frames; most per hectare around pole {first.pole} ({first.kind}): "
            f"{first.per_hectare:.0f}"
        ]
        for count in COUNTS:
            rules = [
                f"{chosen.rule} {', '.join(map(str, chosen.poles))}: {chosen.covered}"
                for chosen in self.placed
                if chosen.count == count
            ]
            sentences.append(
                f"{count} sensor{'s' if count > 1 else ''}, errors covered by the poles of {'; '.join(rules)}"
            )
        for town in self.towns:
            first = f"{town.town}: {town.errors} errors; one sensor covers {town.shares[0]:.0%}"
            sentences.append(f"{first}, {town.poles} cover {town.shares[-1]:.0%}")
        return sentences


def fig3b(out: Path, progress: Report = ignore_progress) -> tuple[Fig3b, dict[str, bytes]]:
    """Record drives into `out` and register the detector's errors; return the results, and PNG files by name."""
    data, town, registry = _drive(RECIPE, out / "data", progress)
    towns = [cover_town(town, registry.positions, RANGE_M)]
    for town_name, seed in OTHERS.items():
        _, other, errors = _drive({**RECIPE, "town": town_name, "seed": seed}, out / town_name, progress)
        towns.append(cover_town(other, errors.positions, RANGE_M))
    traces = [trace for scene in sorted({key.scene for key in data.keys}) if (trace := data.trace(scene)) is not None]
    places = np.array([data.world_from_agent(number)[:2, 3] for number in range(len(data))])
    candidates = find_candidates(registry.positions, town.poles.position, [RANGE_M]).at_unit_cost()
    density = measure_traffic_density(town.poles.position, traces, RANGE_M)
    visible = count_visible_actors(town, traces, town.poles.position, [RANGE_M]).ravel()
    results = Fig3b(
        frames=len(data),
        errors=len(registry),
        zones=_count_zones(town, registry.positions, places, density),
        placed=tuple(_place(candidates, town, {"visible objects": visible, "traffic density": density})),
        towns=tuple(towns),
        provenance=provenance(),
    )
    pictures = {"fig3b.png": _draw(town, registry.positions, np.array(registry.kinds, dtype=np.str_), results)}
    return results, pictures | {"cover.png": draw_towns(towns)}


def _drive(recipe: Mapping[str, Any], folder: Path, progress: Report) -> tuple[Dataset, Town, Registry]:
    """Record drives in a town; return the data set, the town, and the errors of the package's detector."""
    record(EmbeddedSource(parse_config(Recipe, dict(recipe), "fig3b")), folder)
    data = Dataset.open(folder)
    town = data.town()
    assert town is not None
    return data, town, OBJECTS.register_errors(resolve_network(OBJECTS, None), data, progress=progress)


def draw_towns(towns: Sequence[TownCover]) -> bytes:
    """Return a PNG: the share of errors that each number of sensors covers in each town, and errors by scenario."""
    kinds = list_kinds(towns)
    shares = {cover.town: cover.shares for cover in towns}
    around = {cover.town: [cover.kinds.get(kind) for kind in kinds] for cover in towns}
    return style.png(draw_cover(shares, kinds, around))


def _count_zones(
    town: Town, errors: NDArray[np.float64], frames: NDArray[np.float64], density: NDArray[np.float64]
) -> tuple[Zone, ...]:
    hectares = np.pi * ZONE_M**2 / 1e4
    zones = []
    for number, at, kind, actors in zip(town.poles.id, town.poles.position, town.poles.kind, density, strict=True):
        inside = int((np.linalg.norm(errors[:, :2] - at[:2], axis=1) <= ZONE_M).sum())
        driven = int((np.linalg.norm(frames - at[:2], axis=1) <= ZONE_M).sum())
        rate = inside / driven if driven else None
        zones.append(Zone(int(number), kind, inside, inside / hectares, rate, float(actors)))
    return tuple(sorted(zones, key=lambda zone: (-zone.errors, zone.pole)))


def _place(candidates: Candidates, town: Town, scores: Mapping[str, NDArray[np.float64]]) -> Sequence[ChosenPoles]:
    def make_row(rule: str, count: int, placed: Placement) -> ChosenPoles:
        return ChosenPoles(rule, count, tuple(int(town.poles.id[pole]) for pole in placed.chosen), placed.covered)

    rows = []
    for count in COUNTS:
        rows.append(make_row("VRCSP", count, place_count(candidates, count)))
        rows += [make_row(rule, count, place_by_score(candidates, score, count)) for rule, score in scores.items()]
    return rows


def _draw(town: Town, errors: NDArray[np.float64], kind: NDArray[np.str_], results: Fig3b) -> bytes:
    first = {chosen.rule: [str(pole) for pole in chosen.poles] for chosen in results.placed if chosen.count == 1}
    poles = poles_of(town)
    scene = ErrorMap(
        town,
        errors,
        kind,
        poles,
        chosen=dict.fromkeys(first["VRCSP"], RANGE_M),
        viewsheds={name: find_viewshed(town, [], poles[name], RANGE_M) for name in first["VRCSP"]},
        conventional={DENSEST: first["traffic density"], MOST_VISIBLE: first["visible objects"]},
        zones={str(zone.pole): zone.per_hectare for zone in results.zones},
        zone_m=ZONE_M,
        heat=True,
    )
    return style.png(town_map(scene))


def tables(results: Fig3b) -> dict[str, str]:
    """Return Markdown by name: zones, placed, towns."""
    zones = [
        [
            zone.pole,
            zone.kind,
            zone.errors,
            f"{zone.per_hectare:.0f}",
            "" if zone.per_frame is None else f"{zone.per_frame:.1f}",
            f"{zone.actors:.1f}",
        ]
        for zone in results.zones
    ]
    placed = [[row.count, row.rule, ", ".join(map(str, row.poles)), row.covered] for row in results.placed]
    header = ("pole", "zone", "errors", "per hectare", "per frame driven there", "actors in reach")
    towns = [
        [
            row.town,
            row.errors,
            row.poles,
            *(f"{row.shares[count - 1]:.0%}" for count in COUNTS),
            f"{row.shares[-1]:.0%}",
            *("" if wanted is None else wanted for wanted in row.wanted),
            *(row.count_for_reached(share) for share in REACHED),
        ]
        for row in results.towns
    ]
    covered = (*(f"covered by {count}" for count in COUNTS), "by all poles")
    asked = (
        *(f"sensors for {share:.0%}" for share in ASKED),
        *(f"for {share:.0%} of those in reach" for share in REACHED),
    )
    return {
        "towns": format_table(("town", "errors", "poles", *covered, *asked), towns),
        "zones": format_table(header, zones),
        "placed": format_table(("sensors", "rule", "poles", "errors covered"), placed),
    }


def _run(out: Path, options: Options) -> Outcome[Fig3b]:
    with options.show_progress(options.title) as report:
        results, pictures = fig3b(out, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(Fig3b, _run, tables, takes=())
