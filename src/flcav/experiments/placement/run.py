"""Proof of placement by learning: what vehicles learn from a sensor on each pole, against what it covers.

All arms of recipes/runs/placement.yaml start from the same pretrained network and train on the same frames in the same
order; they differ in the poles whose sensors help to label them. The gain of poles is the AP50 after edge FL with their
sensors minus that without any, on the same test frames: all of them, and the half with most registered errors around.
If placement by coverage is right, poles that cover more errors have higher gains (Spearman's rank correlation; Wang et
al., IEEE Network 37(3), 2023, finding iii), and the choice of VRCSP gains more than the densest or random poles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.files import Json
from flcav.intervals import MOST_SEEDS, MeanOverSeeds, half_width, mean_over_seeds
from flcav.optimization.curves.held_out import rank_correlation
from flcav.perception.errors import load_errors
from flcav.perception.outcomes import Outcomes, as_measurable
from flcav.perception.tasks import task_named
from flcav.pipeline.arms import Names, resolve_settings
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.sources import choose_labels
from flcav.pipeline.provenance import Provenance, provenance
from flcav.pipeline.recipe import EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.pipeline.results.placement import Placed
from flcav.pipeline.results.run import Run
from flcav.pipeline.results.saved import ERRORS, OUTCOMES
from flcav.records import LEFT_OUT, Record
from flcav.report import style
from flcav.report.charts.placement import draw_gains
from flcav.world.map.town import load_town

TASK = "objects"
TOWN, NEAR = "all over the town", "near the errors"  # test frames
RULES = {"vrcsp": "VRCSP", "densest": "traffic density", "random": "random"}  # by the rule in a recipe
COVERAGE, TRAFFIC = "errors covered", "traffic density"  # what may predict a pole's gain
HALF_WIDTH = 0.02  # of an interval in AP50 that seeds are planned for

ByFrames = Mapping[str, float]  # a number by `TOWN` and `NEAR`


@dataclass(frozen=True)
class Pair:
    """Two candidate poles whose circles of coverage overlap."""

    poles: tuple[int, int]
    apart_m: float
    overlap: float  # share of a circle that lies in the other one


@dataclass(frozen=True)
class PoleGain:
    """Gain in AP of vehicles that learn from the sensor on one pole."""

    pole: int
    covered: int  # errors within range
    actors: float  # mean number of road users within range
    gain: ByFrames  # in AP50


@dataclass(frozen=True)
class ChoiceGain:
    """Gain in AP of vehicles that learn from the sensors that a rule places."""

    rule: str
    count: int
    poles: tuple[int, ...]  # none: the mean over all single poles
    gain: ByFrames


@dataclass(frozen=True)
class SeedGains:
    """Gains of one seed, and how well coverage and traffic order the poles by them."""

    seed: int
    errors: int  # registered
    pretrained: ByFrames  # AP50
    without: ByFrames  # AP50 of edge FL without sensors
    poles: tuple[PoleGain, ...]  # that see road users
    choices: tuple[ChoiceGain, ...]
    correlation: Mapping[str, ByFrames]  # Spearman's, by predictor


@dataclass(frozen=True)
class PlacementProof(Record):
    """Gains by pole and by rule, over seeds."""

    region: str
    range_m: float
    overlaps: tuple[Pair, ...]  # of all pairs of poles that are nearer than two ranges
    seeds: tuple[SeedGains, ...]
    correlation: Mapping[str, Mapping[str, MeanOverSeeds]]  # by predictor and frames
    gain: Mapping[str, Mapping[str, MeanOverSeeds]]  # by "count, rule" and frames
    advantage: Mapping[str, Mapping[str, MeanOverSeeds]]  # of VRCSP over the rule, by "count, rule" and frames
    pair_sd: ByFrames  # standard deviation over seeds of the difference of two poles' gains, over all pairs
    seeds_wanted: Mapping[str, int | None]  # that make the half-width of such a difference `HALF_WIDTH`
    recipe: Annotated[Mapping[str, Json] | None, LEFT_OUT] = None
    provenance: Annotated[Provenance | None, LEFT_OUT] = None

    def sentences(self) -> list[str]:
        """Return correlations, advantages and the number of seeds in words."""
        told = [
            f"rank correlation of gain and {predictor}, {frames}: {mean.describe(sign=True)}"
            for predictor, own in self.correlation.items()
            for frames, mean in own.items()
        ]
        told += [
            f"{name}: VRCSP gains {mean.describe(sign=True)} AP50 more {frames}"
            for name, own in self.advantage.items()
            for frames, mean in own.items()
        ]
        for frames, wanted in self.seeds_wanted.items():
            if wanted is not None:
                sd = self.pair_sd[frames]
                told.append(
                    f"two poles' gains differ by {sd:.3f} (standard deviation over seeds) {frames}: "
                    f"{wanted} seeds make the half-width {HALF_WIDTH}"
                )
        return told


def overlap_of_circles(apart: float, radius: float) -> float:
    """Return the share of a circle's area that lies in another one of the same radius, `apart` between the centres."""
    half = apart / (2 * radius)
    if half >= 1:
        return 0.0
    return float(2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2)))


def list_overlaps(recipe: RunRecipe, beside: Path | None = None) -> tuple[Pair, ...]:
    """Return the pairs of candidate poles of the recipe's federating region whose circles overlap, the most first."""
    region = _region(recipe)
    poles, radius = load_town(recipe.regions[region].town or region, beside).poles, recipe.placement.range_m
    pairs = []
    for (one, here), (other, there) in combinations(zip(poles.id.tolist(), poles.position, strict=True), 2):
        apart = float(np.linalg.norm(here[:2] - there[:2]))
        if (share := overlap_of_circles(apart, radius)) > 0:
            pairs.append(Pair((one, other), apart, share))
    return tuple(sorted(pairs, key=lambda pair: -pair.overlap))


def describe_overlaps(pairs: Sequence[Pair], range_m: float) -> str:
    """Return in words how much the circles of candidate poles overlap."""
    if not pairs:
        return f"no two circles of {range_m:g} m around candidate poles overlap"
    told = ", ".join(f"{pair.poles[0]} and {pair.poles[1]} by {pair.overlap:.0%}" for pair in pairs)
    return f"circles of {range_m:g} m around candidate poles that overlap: {told}"


def prove_placement(recipe: RunRecipe, runs: Sequence[Run], works: Sequence[Path]) -> PlacementProof:
    """Return gains by pole and rule in the first federating region of the recipe, over the runs of its seeds.

    `works`: the folder of each run's steps, with the outcomes of its tests. Raises `InputError` where a run has no arm
    with a single pole, or the test frames hold nothing to find.
    """
    return summarise_gains(recipe, tuple(measure_gains(run, work) for run, work in zip(runs, works, strict=True)))


def summarise_gains(recipe: RunRecipe, seeds: tuple[SeedGains, ...]) -> PlacementProof:
    """Return the means over seeds of gains, of VRCSP's advantages and of correlations, with 95 % intervals."""
    gain, advantage = {}, {}
    for number, choice in enumerate(seeds[0].choices):
        name = f"{choice.count}, {choice.rule}"
        own = [seed.choices[number].gain for seed in seeds]
        gain[name] = _mean_by_frames(own)
        if choice.rule != RULES["vrcsp"]:
            best = [_find_choice(seed, RULES["vrcsp"], choice.count) for seed in seeds]
            advantage[name] = _mean_by_frames([{f: a[f] - b[f] for f in b} for a, b in zip(best, own, strict=True)])
    spread = {frames: _spread_of_pairs(seeds, frames) for frames in (TOWN, NEAR)}
    return PlacementProof(
        region=_region(recipe),
        range_m=recipe.placement.range_m,
        overlaps=list_overlaps(recipe),
        seeds=seeds,
        correlation={each: _mean_by_frames([seed.correlation[each] for seed in seeds]) for each in (COVERAGE, TRAFFIC)},
        gain=gain,
        advantage=advantage,
        pair_sd=spread,
        seeds_wanted={frames: plan_half_width(sd) if len(seeds) > 1 else None for frames, sd in spread.items()},
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def plan_half_width(sd: float, half: float = HALF_WIDTH) -> int | None:
    """Return the least number of seeds whose mean has an interval of half-width `half`; None for too many."""
    return next((seeds for seeds in range(2, MOST_SEEDS) if half_width(sd, seeds) <= half), None)


def choose_near(places: NDArray[np.float64], errors: NDArray[np.float64], range_m: float) -> NDArray[np.bool_]:
    """Return (F,) whether a frame is of the half with most errors within `range_m`, horizontally.

    `places` (F, 2) of the vehicles, `errors` (E, 3), world [m]; of equals the earlier frames are taken.
    """
    apart = np.linalg.norm(places[:, None] - errors[None, :, :2], axis=2)
    order = np.argsort(-(apart <= range_m).sum(axis=1), kind="stable")
    near = np.zeros(len(places), dtype=np.bool_)
    near[order[: -(-len(places) // 2)]] = True
    return near


def measure_gains(run: Run, work: Path) -> SeedGains:
    """Return the gains of one seed's run from the outcomes of its tests, whose folders are in `work`."""
    recipe, region = run.recipe, _region(run.recipe)
    names = Names(
        resolve_settings(recipe, {task: choose_labels(task, own.labels) for task, own in recipe.tasks.items()})
    )
    split = Frames.open(work / names.recording(region, "test", TASK))
    errors = load_errors(work / names.errors(MAIN, region, TASK) / ERRORS)
    places = np.array([split.data.world_from_agent(number)[:2, 3] for number in split.vehicles])
    spots = np.array([(error.x, error.y, error.z) for error in errors]).reshape(-1, 3)
    counted = {
        TOWN: np.ones(len(places), dtype=np.bool_),
        NEAR: choose_near(places, spots, recipe.placement.range_m),
    }
    tested = {
        (test.arm, test.stage): _precision(work / test.step / OUTCOMES, counted)
        for test in run.tested
        if (test.region, test.task) == (region, TASK)
    }
    without = tested[MAIN, EDGE]
    gains = {
        arm: {frames: value[frames] - without[frames] for frames in value}
        for (arm, stage), value in tested.items()
        if stage == EDGE
    }
    placed = {arm: _placed(run, arm, region) for arm in gains}
    known = {site.pole: site for site in placed[MAIN].poles if site.actors > 0}
    poles = tuple(
        PoleGain(pole, known[pole].covered, known[pole].actors, gains[arm])
        for arm, each in placed.items()
        if each.rule == "fixed" and len(each.chosen) == 1 and (pole := each.chosen[0]) in known
    )
    if not poles:
        raise InputError(f"region '{region}': no arm has a sensor on a single pole that sees road users")
    several = tuple(
        ChoiceGain(RULES[each.rule], len(each.chosen), each.chosen, gains[arm])
        for arm, each in placed.items()
        if each.rule in RULES
    )
    return SeedGains(
        seed=recipe.seed,
        errors=placed[MAIN].errors,
        pretrained=tested[MAIN, PRETRAIN],
        without=without,
        poles=poles,
        choices=(*_choose_one(poles), *sorted(several, key=lambda choice: choice.count)),
        correlation={
            COVERAGE: _correlate(poles, [each.covered for each in poles]),
            TRAFFIC: _correlate(poles, [each.actors for each in poles]),
        },
    )


def _region(recipe: RunRecipe) -> str:
    return recipe.with_role("federate")[0]


def _placed(run: Run, arm: str, region: str) -> Placed:
    return next(each for each in run.arms[arm].placed if each.region == region)


def _precision(path: Path, counted: Mapping[str, NDArray[np.bool_]]) -> dict[str, float]:
    """Return AP50 on each choice of frames; raises `InputError` where one holds nothing to find."""
    outcomes, task = Outcomes.load(path), as_measurable(task_named(TASK))
    found = {frames: float(task.measure(outcomes, own[None].astype(np.int64))[0]) for frames, own in counted.items()}
    if any(np.isnan(value) for value in found.values()):
        raise InputError(f"{path.parent.name}: the test frames hold nothing to find; take more scenes")
    return found


def _choose_one(poles: Sequence[PoleGain]) -> tuple[ChoiceGain, ...]:
    """Return the gains of one sensor by each rule; at random it is the mean over all poles."""
    best = max(poles, key=lambda pole: pole.covered)
    dense = max(poles, key=lambda pole: pole.actors)
    mean = {frames: float(np.mean([pole.gain[frames] for pole in poles])) for frames in best.gain}
    return (
        ChoiceGain(RULES["vrcsp"], 1, (best.pole,), best.gain),
        ChoiceGain(RULES["densest"], 1, (dense.pole,), dense.gain),
        ChoiceGain(RULES["random"], 1, (), mean),
    )


def _correlate(poles: Sequence[PoleGain], predictor: Sequence[float]) -> dict[str, float]:
    return {frames: rank_correlation([pole.gain[frames] for pole in poles], predictor) for frames in (TOWN, NEAR)}


def _find_choice(seed: SeedGains, rule: str, count: int) -> ByFrames:
    return next(each.gain for each in seed.choices if (each.rule, each.count) == (rule, count))


def _mean_by_frames(values: Sequence[ByFrames]) -> dict[str, MeanOverSeeds]:
    return {frames: mean_over_seeds([each[frames] for each in values]) for frames in (TOWN, NEAR)}


def _spread_of_pairs(seeds: Sequence[SeedGains], frames: str) -> float:
    """Return the standard deviation over seeds of the difference of two poles' gains, variances averaged over pairs.

    Poles that some seed lacks are left out; 0 of a single seed.
    """
    each = [{pole.pole: pole.gain[frames] for pole in seed.poles} for seed in seeds]
    common = sorted(set.intersection(*(set(own) for own in each)))
    gains = np.array([[own[pole] for pole in common] for own in each])
    if len(seeds) < 2 or len(common) < 2:
        return 0.0
    variances = [np.var(gains[:, i] - gains[:, j], ddof=1) for i, j in combinations(range(len(common)), 2)]
    return float(np.sqrt(np.mean(variances)))


def draw_proof(results: PlacementProof) -> bytes:
    """Return the picture of every pole's gain against its coverage and its traffic as a PNG."""
    panels = {}
    for frames in (TOWN, NEAR):
        for predictor, field in ((COVERAGE, "covered"), (TRAFFIC, "actors")):
            panels[frames, predictor] = {
                seed.seed: [(float(getattr(pole, field)), pole.gain[frames]) for pole in seed.poles]
                for seed in results.seeds
            }
    return style.png(draw_gains(panels))
