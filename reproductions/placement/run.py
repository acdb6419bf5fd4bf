"""Test of placement by learning: the gain of vehicles from a sensor on each pole, against the errors that it covers.

All arms of recipes/runs/placement.yaml start from the same pretrained network and train on the same frames in the same
order; they differ in the poles whose sensors help to label them. The gain of poles is the AP50 after edge FL with their
sensors minus that without any, on the same test frames: all of them, and the half with most registered errors around.
If placement by coverage is right, poles that cover more errors have higher gains (Spearman's rank correlation; Wang et
al., IEEE Network 37(3), 2023, finding iii), and the choice of VRCSP gains more than the densest or random poles.

Two more quantities may predict the gain of a pole. *Expected labels*: the registered misses in its line of sight, each
with the probability that the road detector finds it at that distance (`expect_labels`). *Added labels*: those that its
sensor really adds to the pseudo-labels of the training frames (`count_added_labels`).

Each federating region with an arm of a single pole is tested on its own. Regions of one seed share their pretraining,
so that pooled numbers are means over regions first, and over seeds second.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.ground import DatasetGround
from flcav.experiments.experiment import Experiment, Options, Outcome, import_map, list_works, shrink_recipe
from flcav.fusion.labels import label_sample
from flcav.optimization.curves.held_out import rank_correlation
from flcav.perception.errors import MISS, PerceptionError, load_errors
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.outcomes import Outcomes
from flcav.perception.weights import load_network
from flcav.report import style
from flcav.report.charts.placement import draw_correlations
from flcav.reproductions.placement.records import (
    ADDED,
    COVERAGE,
    EXPECTED,
    FRAMES,
    HALF_WIDTH,
    NEAR,
    PREDICTORS,
    RULES,
    TOWN,
    TRAFFIC,
    ByFrames,
    ChoiceGain,
    Means,
    Pair,
    PlacementProof,
    PoleGain,
    RegionProof,
    SeedGains,
    describe_claims,
    pool_over_seeds,
    spread_over_scenes,
    spread_over_seeds,
)
from flcav.reproductions.placement.tables import tables
from flcav.runs.frames import Frames
from flcav.runs.labels.pseudo_labels import road_views, select_frames_near
from flcav.runs.poles import find_sites, read_traces
from flcav.runs.provenance import provenance
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import Run
from flcav.runs.results.saved import ERRORS, OUTCOMES, WEIGHTS
from flcav.runs.results.training import Pretrained
from flcav.statistics.power import MOST_SEEDS
from flcav.statistics.seeds import MeanOverSeeds, half_width, mean_over_seeds
from flcav.world.line_of_sight import find_visible_pairs
from flcav.world.map.town import Town, load_town
from flcav.world.trace import Trace

TASK = "objects"

Numbers = Mapping[str, ByFrames]  # by name and choice of frames

IMPORTED = "quarter"  # map of the package that is imported as a town


@dataclass(frozen=True)
class _Folders:
    """The recordings, errors and pretrained network that a run left in one region."""

    test: Frames
    registry: Frames
    edge: Frames
    errors: tuple[PerceptionError, ...]
    pretrained: Path

    @classmethod
    def open(cls, run: Run, work: Path, region: str) -> "_Folders":
        names = run.steps
        test, registry, edge = (
            Frames.open(work / names.recording(region, split, TASK)) for split in ("test", "registry", EDGE)
        )
        errors = load_errors(work / names.errors(MAIN, region, TASK) / ERRORS)
        return cls(test, registry, edge, errors, work / names.pretrain(MAIN, TASK))


def list_regions(recipe: RunRecipe) -> tuple[str, ...]:
    """Return the federating regions in which an arm has a sensor on a single pole; raises `InputError` for none."""
    federating = recipe.with_role("federate")
    single = [arm for arm in recipe.arms.values() if len(arm.placement.get("poles", ())) == 1]
    regions = tuple(region for region in federating if any(region in (arm.regions or federating) for arm in single))
    if not regions:
        raise InputError("no arm has a sensor on a single pole")
    return regions


def prove_placement(
    recipe: RunRecipe, runs: Sequence[Run], works: Sequence[Path], beside: Path | None = None
) -> PlacementProof:
    """Return gains by pole and rule in the regions of `list_regions`, over the runs of the recipe's seeds.

    `works`: the folder of each run's steps, with the outcomes of its tests; `beside`: the folder in which towns are
    looked for. Raises `InputError` where a run has no arm with a single pole, or the test frames contain no targets.
    """
    measured = {
        region: tuple(measure_gains(run, work, region) for run, work in zip(runs, works, strict=True))
        for region in list_regions(recipe)
    }
    return summarise_gains(recipe, measured, beside)


def summarise_gains(
    recipe: RunRecipe, measured: Mapping[str, tuple[SeedGains, ...]], beside: Path | None = None
) -> PlacementProof:
    """Return the means over seeds of gains, of VRCSP's advantages and of correlations, with 95 % intervals.

    measured: gains by region, of the same seeds in all.
    """
    regions = {}
    for region, seeds in measured.items():
        spread = {frames: spread_over_seeds(seeds, frames) for frames in FRAMES}
        regions[region] = RegionProof(
            town=recipe.regions[region].town or region,
            overlaps=list_overlaps(recipe, region, beside),
            seeds=seeds,
            means=_mean([[seed] for seed in seeds]),
            pair_sd=spread,
            seeds_wanted={frames: plan_half_width(sd) if len(seeds) > 1 else None for frames, sd in spread.items()},
            scene_sd=pool_over_seeds(seeds),
        )
    return PlacementProof(
        range_m=recipe.placement.range_m,
        regions=regions,
        pooled=_mean(list(zip(*measured.values(), strict=True))),
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


def _mean(seeds: Sequence[Sequence[SeedGains]]) -> Means:
    """Return means over `seeds` of the mean over the regions of each."""
    return Means(
        correlation=_mean_numbers([[gains.correlation for gains in regions] for regions in seeds]),
        gain=_mean_numbers([[_list_gains(gains) for gains in regions] for regions in seeds]),
        advantage=_mean_numbers([[_list_advantages(gains) for gains in regions] for regions in seeds]),
    )


def _mean_numbers(seeds: Sequence[Sequence[Numbers]]) -> dict[str, dict[str, MeanOverSeeds]]:
    """Return the means over seeds of the mean over regions, for the names that all have."""
    flat = [numbers for regions in seeds for numbers in regions]
    names = [name for name in flat[0] if all(name in numbers for numbers in flat)]
    return {
        name: {
            frames: mean_over_seeds([float(np.mean([row[name][frames] for row in regions])) for regions in seeds])
            for frames in FRAMES
        }
        for name in names
    }


def _list_gains(seed: SeedGains) -> Numbers:
    return {choice.name: choice.gain for choice in seed.choices}


def _list_advantages(seed: SeedGains) -> Numbers:
    best = {choice.count: choice.gain for choice in seed.choices if choice.rule == RULES["vrcsp"]}
    return {
        choice.name: {frames: best[choice.count][frames] - gain for frames, gain in choice.gain.items()}
        for choice in seed.choices
        if choice.rule != RULES["vrcsp"]
    }


def plan_half_width(sd: float, half: float = HALF_WIDTH) -> int | None:
    """Return the least number of seeds whose mean has a half-width of at most `half`; None above `MOST_SEEDS`."""
    return next((seeds for seeds in range(2, MOST_SEEDS) if half_width(sd, seeds) <= half), None)


def choose_near(places: NDArray[np.float64], errors: NDArray[np.float64], range_m: float) -> NDArray[np.bool_]:
    """Return (F,) whether a frame belongs to the half with most errors within the horizontal distance `range_m`.

    `places` (F, 2) of the vehicles, `errors` (E, 3), world frame [m]. Of frames with equally many errors the earlier
    ones are chosen.
    """
    apart = np.linalg.norm(places[:, None] - errors[None, :, :2], axis=2)
    order = np.argsort(-(apart <= range_m).sum(axis=1), kind="stable")
    near = np.zeros(len(places), dtype=np.bool_)
    near[order[: -(-len(places) // 2)]] = True
    return near


def measure_gains(run: Run, work: Path, region: str) -> SeedGains:
    """Return the gains in one seed's run in a region, from the outcomes of its tests in folders of `work`."""
    recipe, folders = run.recipe, _Folders.open(run, work, region)
    split = folders.test
    places = np.array([split.data.world_from_agent(number)[:2, 3] for number in split.vehicles])
    spots = np.array([(error.x, error.y, error.z) for error in folders.errors]).reshape(-1, 3)
    counted = {
        TOWN: np.ones(len(places), dtype=np.bool_),
        NEAR: choose_near(places, spots, recipe.placement.range_m),
    }
    outcomes = {
        (test.arm, test.stage): Outcomes.load(work / test.step / OUTCOMES)
        for test in run.tested
        if (test.region, test.task) == (region, TASK)
    }
    tested = {key: _precision(result, counted, region) for key, result in outcomes.items()}
    without = tested[MAIN, EDGE]
    gains = {
        arm: {frames: value[frames] - without[frames] for frames in value}
        for (arm, stage), value in tested.items()
        if stage == EDGE
    }
    placed = {arm: _placed(run, arm, region) for arm in gains}
    poles = _measure_poles(recipe, folders, placed, gains)
    if not poles:
        raise InputError(f"region '{region}': no arm has a sensor on a single pole that sees road users")
    known = {pole.pole for pole in poles}
    single = [arm for arm, at in placed.items() if at.rule == "fixed" and at.chosen in {(pole,) for pole in known}]
    several = tuple(
        ChoiceGain(RULES[placement.rule], len(placement.chosen), placement.chosen, gains[arm])
        for arm, placement in placed.items()
        if placement.rule in RULES
    )
    return SeedGains(
        seed=recipe.seed,
        errors=placed[MAIN].errors,
        pretrained=tested[MAIN, PRETRAIN],
        without=without,
        poles=poles,
        choices=(*_choose_one(poles), *sorted(several, key=lambda choice: choice.count)),
        correlation={name: _correlate(poles, name) for name in PREDICTORS},
        scene_sd=spread_over_scenes([outcomes[arm, EDGE] for arm in single], counted, recipe.seed),
    )


def _measure_poles(
    recipe: RunRecipe, folders: _Folders, placed: Mapping[str, Placed], gains: Mapping[str, ByFrames]
) -> tuple[PoleGain, ...]:
    """Return gains and predictors of the poles that see road users and have the only sensor of an arm."""
    known = {site.pole: site for site in placed[MAIN].poles if site.actors > 0}
    single = {
        pole: gains[arm]
        for arm, placement in placed.items()
        if placement.rule == "fixed" and len(placement.chosen) == 1 and (pole := placement.chosen[0]) in known
    }
    if not single:
        return ()
    sites, town = find_sites(folders.registry, None), folders.registry.data.town()
    if town is None:
        raise InputError(f"{folders.registry.data.folder}: recorded in no known town, so that no pole's sight is known")
    position_of = dict(zip(sites.number.tolist(), sites.position, strict=True))
    traces = read_traces(folders.registry.data, folders.registry.vehicles)
    mounts = np.array([position_of[pole] for pole in single]).reshape(-1, 3)
    expected = dict(zip(single, expect_labels(town, traces, folders.errors, mounts).tolist(), strict=True))
    network, threshold = load_network(OBJECTS, folders.pretrained / WEIGHTS), _threshold(folders)
    occupied = [position_of[pole][:2] for placement in placed.values() for pole in placement.chosen]
    near = np.array(occupied).reshape(-1, 2)
    frames = select_frames_near(folders.edge, near, recipe.placement.group_range_m)
    added = count_added_labels(network, threshold, folders.edge, frames, {pole: position_of[pole] for pole in single})
    return tuple(
        PoleGain(
            pole,
            {
                COVERAGE: known[pole].covered,
                TRAFFIC: known[pole].actors,
                EXPECTED: round(expected[pole], 2),
                ADDED: added[pole],
            },
            gain,
        )
        for pole, gain in single.items()
    )


def _threshold(folders: _Folders) -> float:
    """Return the score threshold of pseudo-labels; raises `InputError` if labels are not made from detections."""
    threshold = Pretrained.load(folders.pretrained).threshold
    if threshold is None:
        raise InputError("the labels of 'objects' come from no detections, so that no sensor adds any")
    return threshold


def _placed(run: Run, arm: str, region: str) -> Placed:
    return next(placement for placement in run.arms[arm].placed if placement.region == region)


def _precision(outcomes: Outcomes, counted: Mapping[str, NDArray[np.bool_]], region: str) -> dict[str, float]:
    """Return AP50 on each choice of frames; raises `InputError` where one contains no targets."""
    ap50 = {
        frames: float(OBJECTS.measure(outcomes, is_counted[None].astype(np.int64))[0])
        for frames, is_counted in counted.items()
    }
    if any(np.isnan(value) for value in ap50.values()):
        raise InputError(f"region '{region}': the test frames hold nothing to find; take more scenes")
    return ap50


def _choose_one(poles: Sequence[PoleGain]) -> tuple[ChoiceGain, ...]:
    """Return the gains of a single sensor by each rule; for the random rule the mean over all poles."""
    rules = {RULES["vrcsp"]: COVERAGE, RULES["densest"]: TRAFFIC, EXPECTED: EXPECTED}
    best = {rule: max(poles, key=lambda pole: pole.predictors[name]) for rule, name in rules.items()}
    mean = {frames: float(np.mean([pole.gain[frames] for pole in poles])) for frames in FRAMES}
    return (
        *(ChoiceGain(rule, 1, (pole.pole,), pole.gain) for rule, pole in best.items()),
        ChoiceGain(RULES["random"], 1, (), mean),
    )


def _correlate(poles: Sequence[PoleGain], name: str) -> dict[str, float]:
    predictor = [pole.predictors[name] for pole in poles]
    return {frames: rank_correlation([pole.gain[frames] for pole in poles], predictor) for frames in FRAMES}


def draw_proof(results: PlacementProof) -> dict[str, bytes]:
    """Return a PNG per region, by file name: rank correlations of the poles' gains with each predictor, by seed."""
    pictures = {}
    for region, proof in results.regions.items():
        seeds = {
            name: {frames: [seed.correlation[name][frames] for seed in proof.seeds] for frames in FRAMES}
            for name in PREDICTORS
        }
        means = {
            name: {frames: mean.as_estimate() for frames, mean in proof.means.correlation[name].items()}
            for name in PREDICTORS
        }
        pictures[f"placement-{region}.png"] = style.png(draw_correlations(seeds, means))
    return pictures


def overlap_of_circles(apart: float, radius: float) -> float:
    """Return the share of a circle's area in another one of equal radius; `apart`: distance of centres, same unit."""
    half = apart / (2 * radius)
    if half >= 1:
        return 0.0
    return float(2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2)))


def list_overlaps(recipe: RunRecipe, region: str, beside: Path | None = None) -> tuple[Pair, ...]:
    """Return the pairs of candidate poles of a region whose circles overlap, in descending order of overlap.

    The region's town is looked for in the folder `beside`.
    """
    poles, radius = load_town(recipe.regions[region].town or region, beside).poles, recipe.placement.range_m
    pairs = []
    for (one, here), (other, there) in combinations(zip(poles.id.tolist(), poles.position, strict=True), 2):
        apart = float(np.linalg.norm(here[:2] - there[:2]))
        if (share := overlap_of_circles(apart, radius)) > 0:
            pairs.append(Pair((one, other), apart, share))
    return tuple(sorted(pairs, key=lambda pair: -pair.overlap))


def describe_overlaps(pairs: Mapping[str, Sequence[Pair]], range_m: float) -> list[str]:
    """Return a sentence for each region: which circles of candidate poles overlap, and by how much."""
    lists = {
        region: ", ".join(f"{pair.poles[0]} and {pair.poles[1]} by {pair.overlap:.0%}" for pair in pairs_here)
        for region, pairs_here in pairs.items()
    }
    return [
        f"{region}: circles of {range_m:g} m around candidate poles that overlap: {listed}"
        if listed
        else f"{region}: no two circles of {range_m:g} m around candidate poles overlap"
        for region, listed in lists.items()
    ]


Array = NDArray[np.float64]

BIN_M = 5.0  # width of the bins of horizontal distance from the pole
# Recall of the road detector in each bin, as measured by reproductions/sensor_ranges.
RECALL = np.array((0.67, 0.99, 0.92, 0.96, 0.91, 0.97, 0.94, 0.86, 0.53, 0.29, 0.05, 0.0))
REACH_M = 100.0  # farther apart, a pole and a vehicle see no common objects


def expect_labels(town: Town, traces: Sequence[Trace], errors: Sequence[PerceptionError], sites: Array) -> Array:
    """Return (P,) the expected labels of a sensor on each of `sites` (P, 3), world frame [m]: see the module.

    traces: traffic, whose vehicles may block the line of sight.
    """
    missed = [error for error in errors if error.kind == MISS and error.returns > 0]
    places = np.array([(error.x, error.y, error.z) for error in missed]).reshape(-1, 3)
    apart = np.linalg.norm(sites[:, None, :2] - places[None, :, :2], axis=2)
    recall = np.append(RECALL, 0.0)[np.minimum(apart / BIN_M, len(RECALL)).astype(np.int64)]
    pole, error = (rows.astype(np.int64) for rows in np.nonzero(recall))
    seen = find_visible_pairs(town, traces, sites, places, (pole, error))
    return np.bincount(pole, recall[pole, error] * seen, minlength=len(sites)).astype(np.float64)


def count_added_labels(
    network: Second, threshold: float, split: Frames, frames: Sequence[int], poles: Mapping[int, Array]
) -> dict[int, int]:
    """Return by pole the number of labels that its sensor adds to vehicles' `frames` of a split: see the module.

    The vehicles' own labels are the detections of `network` that score `threshold` or more. poles: positions (3,) of
    poles whose sweeps are in the split, world frame [m].
    """
    keys, relief = split.data.keys, DatasetGround(split.data).relief
    detected = {i: detect_in(network, [split.data.frame(i)], score_threshold=threshold)[0] for i in frames}
    added = {}
    for pole, place in poles.items():
        near = [i for i in frames if np.linalg.norm((split.data.world_from_agent(i)[:3, 3] - place)[:2]) <= REACH_M]
        spins = {(keys[i].scene, keys[i].index) for i in near}
        views = road_views(split, [pole], True, spins)
        added[pole] = 0
        for i in near:
            frame, views_here = split.data.frame(i), [*views.get((keys[i].scene, keys[i].index), {}).values()]
            lidar = choose_lidar(frame)
            alone, helped = (
                label_sample(frame, detected[i], road, network.config, lidar, relief) for road in ([], views_here)
            )
            if helped.exact is not None:
                from_road, known = helped.boxes[helped.exact], alone.boxes.center[:, :2]
                offset = np.linalg.norm(from_road.center[:, None, :2] - known[None], axis=2)
                added[pole] += int((offset >= from_road.size[:, :1] / 2).all(axis=1).sum())
    return added


def _run(out: Path, options: Options) -> Outcome[PlacementProof]:
    recipe = options.load("placement", shrink_recipe)
    import_map(IMPORTED, out)
    overlaps = {region: list_overlaps(recipe, region, out) for region in list_regions(recipe)}
    runs = options.run_seeds(recipe, out, beside=out)
    results = prove_placement(recipe, runs, list_works(runs, out), out)
    sentences = [
        *describe_overlaps(overlaps, recipe.placement.range_m),
        *results.sentences(),
        *describe_claims(results),
    ]
    return Outcome(results, draw_proof(results), sentences)


EXPERIMENT = Experiment(PlacementProof, _run, tables, seeds=8, recipe="placement")
