"""Predicted against realised gain: which quantity ranks poles as learning does, and how the learning curve ranks plans.

Nothing is trained. The realised gains of poles are those of reproductions/placement, by seed and region; the objects in
sight of a pole are counted in the same traffic, simulated anew. The plans are the rounds of the demo's seeds, each of
them a plan that ends there, and their accuracy is that on validation frames; the curve is of other seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.config import read_json
from flcav.experiments import FOLDER
from flcav.experiments.experiment import Experiment, Options, Outcome, import_map
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.held_out import rank_correlation
from flcav.report import style
from flcav.report.charts.placement import draw_correlations
from flcav.reproductions.placement.records import (
    COVERAGE,
    EXPECTED,
    FRAMES,
    TRAFFIC,
    PlacementProof,
    PoleGain,
    SeedGains,
    list_claims,
)
from flcav.reproductions.placement.run import IMPORTED, TASK
from flcav.runs.analysis.histories import make_history_points
from flcav.runs.frames import make_recording_recipe
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import RunRecipe, load_run_recipe
from flcav.runs.results.run import Run
from flcav.runs.tables import HistoryPoint, parse_history, read_history
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import recipe_path
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds, half_width, mean_over_seeds
from flcav.statistics.verdicts import describe_means, judge_means
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.line_of_sight import count_visible_actors
from flcav.world.map.town import Town, load_town

VISIBLE = "objects in sight"
PREDICTORS = (COVERAGE, TRAFFIC, VISIBLE, EXPECTED)
CORRELATION = "rank correlation"
MOST = 0.999  # largest correlation that has a place on Fisher's scale
PLANS, HISTORY = "demo", "tracks"  # runs of the plans, and the history of the curve that predicts them

Correlations = Mapping[str, Mapping[str, float]]  # rank correlation with the gain, by predictor and choice of frames


@dataclass(frozen=True)
class Predictions(Record):
    """Rank correlations of predicted and realised gains, over seeds."""

    placements: int  # pairs of a region and a pole
    seeds: tuple[Correlations, ...]  # of poles, in the mean over regions, by seed
    poles: Mapping[str, Mapping[str, MeanOverSeeds]]  # by predictor and frames
    averaged: Mapping[str, Mapping[str, Estimate]]  # of the means over seeds, by predictor and frames
    claims: Mapping[str, MeanOverSeeds]  # those of placement and the leads over objects in sight, corrected together
    plans: int  # of a run
    curve: MeanOverSeeds  # of plans
    gain_error: MeanOverSeeds  # mean error of the predicted gain of a plan over pretraining, in its measure
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the verdicts on the claims and the correlation of plans, in words."""
        told = [line for line in describe_means(self.claims) if CORRELATION in line]
        return [*told, f"rank correlation of plans: {self.curve.describe(sign=True)}"]


def count_in_sight(recipe: RunRecipe, region: str, seed: int, town: Town, beside: Path) -> dict[int, float]:
    """Return by pole the mean number of road users in sight within a sensor's range, in the traffic of a seed's drive.

    The drive is that in which a run registers errors. `beside`: the folder in which the town is looked for.
    """
    drawn = recipe.model_copy(update={"seed": seed})
    drive = EmbeddedSource(make_recording_recipe(drawn, region, "registry", TASK, "the drive"), beside)
    traces = [drive.trace(scene) for scene in drive.scenes()]
    counts = count_visible_actors(town, traces, town.poles.position, [recipe.placement.range_m]).ravel()
    return dict(zip(town.poles.id.tolist(), counts.tolist(), strict=True))


def add_sight(gains: SeedGains, in_sight: Mapping[int, float]) -> tuple[PoleGain, ...]:
    """Return the poles of a seed with the objects in sight as a further predictor."""
    return tuple(
        PoleGain(pole.pole, {**pole.predictors, VISIBLE: in_sight[pole.pole]}, pole.gain) for pole in gains.poles
    )


def correlate(regions: Sequence[Sequence[PoleGain]]) -> Correlations:
    """Return the rank correlation of each predictor with the gains of a region's poles, in the mean over regions."""

    def mean(name: str, frames: str) -> float:
        rows = [([pole.gain[frames] for pole in poles], [pole.predictors[name] for pole in poles]) for poles in regions]
        return float(np.mean([rank_correlation(*row) for row in rows]))

    return {name: {frames: mean(name, frames) for frames in FRAMES} for name in PREDICTORS}


def average_poles(seeds: Sequence[Sequence[PoleGain]]) -> tuple[PoleGain, ...]:
    """Return gains and predictors of the poles that all seeds of a region have, in the mean over these seeds."""
    by_pole = [{pole.pole: pole for pole in poles} for poles in seeds]
    common = sorted(set.intersection(*map(set, by_pole)))

    def average(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    return tuple(
        PoleGain(pole, average([own[pole].predictors for own in by_pole]), average([own[pole].gain for own in by_pole]))
        for pole in common
    )


def correlate_averages(regions: Sequence[Sequence[Sequence[PoleGain]]]) -> dict[str, dict[str, Estimate]]:
    """Return the rank correlation of mean predictors with mean gains, with the jackknife's interval over seeds.

    regions: poles by region and seed. The interval is of Student's t on Fisher's scale z = artanh r, by pseudo-values
    n z - (n - 1) z_i, where z_i leaves seed i out (Efron, "The Jackknife, the Bootstrap and Other Resampling Plans",
    1982).
    """
    seeds = len(regions[0])

    def scale(left_out: int | None) -> dict[str, dict[str, float]]:
        kept = [[own for number, own in enumerate(region) if number != left_out] for region in regions]
        found = correlate([average_poles(region) for region in kept])
        return {
            name: {frames: float(np.arctanh(np.clip(r, -MOST, MOST))) for frames, r in by_frames.items()}
            for name, by_frames in found.items()
        }

    def estimate(z: float, parts: Sequence[float]) -> Estimate:
        pseudo = mean_over_seeds([seeds * z - (seeds - 1) * part for part in parts])
        half = half_width(pseudo.sd, seeds)
        low, middle, high = np.tanh([z - half, z, z + half]).tolist()
        return Estimate(middle, low, high)

    whole, parts = scale(None), [scale(number) for number in range(seeds)]
    return {
        name: {frames: estimate(z, [part[name][frames] for part in parts]) for frames, z in by_frames.items()}
        for name, by_frames in whole.items()
    }


def compare_with_sight(seeds: Sequence[Correlations]) -> dict[str, MeanOverSeeds]:
    """Return the claims that errors covered predict the gain better than objects in sight do."""

    def lead(frames: str) -> MeanOverSeeds:
        return mean_over_seeds([seed[COVERAGE][frames] - seed[VISIBLE][frames] for seed in seeds])

    return {f"gain {frames}: {CORRELATION} with {COVERAGE} - with {VISIBLE}": lead(frames) for frames in FRAMES}


def rank_plans(runs: Sequence[Sequence[HistoryPoint]], name: str = HISTORY) -> tuple[MeanOverSeeds, MeanOverSeeds]:
    """Return over runs the rank correlation of plans by the curve of a history, and its mean error of their gains.

    A gain is the accuracy of a plan minus that of pretraining alone, the run's first point.
    """
    curve = fit(parse_history(TASK, read_history(TASK, name, Path()), name), model="best").curve
    ranked, off = [], []
    for points in runs:
        reached = np.array([point.accuracy for point in points])
        spent = [(point.samples, point.edge_rounds, point.cloud_rounds) for point in points]
        predicted = np.array([1 - float(curve.error(*counts, 1)) for counts in spent])
        ranked.append(rank_correlation(predicted, reached))
        off.append(float(np.abs((predicted - predicted[0]) - (reached - reached[0]))[1:].mean()))
    return mean_over_seeds(ranked), mean_over_seeds(off)


def tabulate_predictions(results: Predictions) -> dict[str, str]:
    """Return Markdown by name: correlations, claims, plans."""
    rows = [
        [name, *(by[name][frames].describe(sign=True) for by in (results.poles, results.averaged) for frames in FRAMES)]
        for name in PREDICTORS
    ]
    heads = [f"{what}, {frames}" for what in ("each seed", "means over seeds") for frames in FRAMES]
    return {
        "correlations": format_table(("rank correlation of a pole's gain with its", *heads), rows),
        "claims": format_table(
            ("claim", "mean over seeds", "p, corrected", "verdict", "if undecided: seeds"),
            [
                [name, results.claims[name].describe(sign=True), one.p_cell, one.verdict, one.takes_cell]
                for name, one in judge_means(results.claims).items()
                if CORRELATION in name
            ],
        ),
        "plans": format_table(
            ("runs", "plans of each", "rank correlation of predicted and reached AP50", "mean error of a plan's gain"),
            [
                [
                    results.curve.seeds,
                    results.plans,
                    results.curve.describe(sign=True),
                    results.gain_error.describe(),
                ]
            ],
        ),
    }


def draw_predictions(results: Predictions) -> bytes:
    """Return the rank correlations of poles by seed as a PNG, with means and intervals."""
    names = PREDICTORS
    seeds = {name: {frames: [seed[name][frames] for seed in results.seeds] for frames in FRAMES} for name in names}
    means = {name: {frames: results.poles[name][frames].as_estimate() for frames in FRAMES} for name in names}
    return style.png(draw_correlations(seeds, means))


def _run(out: Path, options: Options) -> Outcome[Predictions]:
    recipe = load_run_recipe(recipe_path("runs/placement"))
    proof = PlacementProof.from_json(read_json(FOLDER / "placement" / "result.json"), "placement")
    import_map(IMPORTED, out)
    regions = list[list[tuple[PoleGain, ...]]]()
    with options.show_progress(options.title) as report:
        for region, own in proof.regions.items():
            town = load_town(own.town, out)
            poles = list[tuple[PoleGain, ...]]()
            for gains in own.seeds:
                poles.append(add_sight(gains, count_in_sight(recipe, region, gains.seed, town, out)))
                report(len(poles), len(own.seeds), region)
            regions.append(poles)
    seeds = tuple(correlate(at) for at in zip(*regions, strict=True))
    runs = [Run.load(path.parent) for path in sorted((FOLDER / "runs" / PLANS).glob("seed*/results.json"))]
    points = [make_history_points(run, f"seed{run.recipe.seed}") for run in runs]
    curve, off = rank_plans(points)
    results = Predictions(
        placements=sum(len(average_poles(region)) for region in regions),
        seeds=seeds,
        poles={
            name: {frames: mean_over_seeds([seed[name][frames] for seed in seeds]) for frames in FRAMES}
            for name in PREDICTORS
        },
        averaged=correlate_averages(regions),
        claims={**list_claims(proof), **compare_with_sight(seeds)},
        plans=len(points[0]),
        curve=curve,
        gain_error=off,
        provenance=provenance(),
    )
    return Outcome(results, {"correlations.png": draw_predictions(results)}, results.sentences())


EXPERIMENT = Experiment(Predictions, _run, tabulate_predictions, seeds=1, takes=())
