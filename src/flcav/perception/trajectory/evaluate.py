"""Displacement errors of forecasts: ADE, FDE and miss rate of modes, single path and constant velocity, by slice.

Errors are kept per road user for intervals over scenes, and large final errors of the single path are registered.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Mask, Words
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.errors import FINAL_ERROR, PerceptionError, Registry, measure_distance
from flcav.perception.outcomes import Outcomes, Times, Values, weighted_mean
from flcav.perception.task import Evaluated
from flcav.perception.trajectory.config import TrajectoryConfig
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import find_medoid, predict_paths
from flcav.perception.trajectory.samples import SEEN_M, Samples, samples_of
from flcav.perception.trajectory.tracks import constant_velocity
from flcav.statistics.bootstrap import REDRAWS
from flcav.storage.records import LEFT_OUT
from flcav.world.trace import Trace

MISS_M = 2.0  # a larger final error is a miss
TURN = np.radians(20.0)  # least angle of a turn between the present heading and the last second's displacement
ALL = "all"  # the slice of all samples


Newer = Annotated[float | None, LEFT_OUT]  # None only in older results


@dataclass(frozen=True, kw_only=True)
class PathErrors:
    """Mean displacement errors [m] and miss rates of a slice of samples.

    ADE is the average displacement error over a path, FDE the final displacement error at its end. They are given for
    the likeliest mode (1), the best of all K modes (K), the single path and constant velocity. A ratio is an FDE
    divided by that of constant velocity, None where the latter is 0.
    """

    samples: int
    minADE_1: float
    minFDE_1: float
    minADE_K: float
    minFDE_K: float
    single_ADE: Newer = None
    single_FDE: Newer = None
    constant_velocity_ADE: float
    constant_velocity_FDE: float
    miss_rate_1: float
    miss_rate_K: float
    miss_rate_single: Newer = None
    miss_rate_constant_velocity: float
    ratio_1: float | None
    ratio_K: float | None
    ratio_single: float | None = None


@dataclass(frozen=True)
class TrajectoryEvaluation(Evaluated):
    """Displacement errors of forecasts, by slice of the samples."""

    modes: int  # K
    miss_m: float  # final error above which a path is a miss
    scenes: int  # number of scenes
    slices: Mapping[str, PathErrors | None]  # all samples, at junctions, turning at junctions; None without samples

    @property
    def score(self) -> float:
        """Return 1 / (1 + (minFDE_1 + minFDE_K) / 2), errors in metres, of all samples; 0 without samples."""
        every = self.slices[ALL]
        if every is None:
            return 0.0
        return 1 / (1 + (every.minFDE_1 + every.minFDE_K) / 2)

    def numbers(self) -> Mapping[str, float]:
        """Return the fields of `PathErrors` as "slice, field", for all slices that have samples."""
        return {
            f"{name}, {key}": value
            for name, errors in self.slices.items()
            if errors is not None
            for key, value in vars(errors).items()
            if value is not None
        }

    def lines(self) -> list[str]:
        """Return a line per slice, followed by a line per predictor."""
        lines = [f"{plural(self.modes, 'mode')}, {plural(self.scenes, 'scene')}; errors in m: average / final / missed"]
        for name, e in self.slices.items():
            if e is None:
                lines.append(f"{name}: none")
                continue
            lines.append(f"{name}: {plural(e.samples, 'sample')}")
            plain = e.constant_velocity_FDE
            for label, ade, fde, missed in (
                ("single path", e.single_ADE, e.single_FDE, e.miss_rate_single),
                ("likeliest mode", e.minADE_1, e.minFDE_1, e.miss_rate_1),
                (f"best of {self.modes}", e.minADE_K, e.minFDE_K, e.miss_rate_K),
                ("constant velocity", e.constant_velocity_ADE, plain, e.miss_rate_constant_velocity),
            ):
                if ade is None or fde is None or missed is None:
                    continue
                ratio = fde / plain if plain else 1.0
                lines.append(f"  {label:<18}{ade:.2f} / {fde:.2f} / {missed:.1%}  ({ratio:.2f}x)")
        return lines


def evaluate_paths(
    paths: Array,
    probabilities: Array,
    past: NDArray[np.floating],
    future: NDArray[np.floating],
    at_junction: Mask,
    scene: Words,
) -> TrajectoryEvaluation:
    """Return the displacement errors of all samples, of those at junctions, and of those turning at junctions.

    `paths` (N, K, FUTURE, 2) [m] and `probabilities` (N, K) are the forecasts of N samples; the other arguments are
    columns of the samples.
    """
    future = future.astype(np.float64)
    slices = {
        ALL: np.ones(len(future), np.bool_),
        "at junctions": at_junction,
        "turning at junctions": at_junction & is_turning(future),
    }
    errors = compute_errors(paths, probabilities, future, constant_velocity(past))
    return TrajectoryEvaluation(
        modes=paths.shape[1],
        miss_m=MISS_M,
        scenes=len(np.unique(scene)),
        slices={name: _means({key: e[rows] for key, e in errors.items()}) for name, rows in slices.items()},
    )


def is_turning(future: Array) -> Mask:
    """Return the mask (N,) of futures (N, FUTURE, 2) [m] that turn.

    A future turns if the displacement in its last second is above 1 m and more than 20 degrees off the x axis.
    """
    last = future[:, -1] - future[:, -5]
    return (np.abs(np.arctan2(last[:, 1], last[:, 0])) > TURN) & (np.linalg.norm(last, axis=1) > 1.0)


def compute_errors(paths: Array, probabilities: Array, future: Array, baseline: Array) -> dict[str, Array]:
    """Return ADE and FDE (N,) [m] of the samples by name: of likeliest mode, best mode, single path, and baseline.

    `paths` are (N, K, FUTURE, 2), `probabilities` (N, K), `future` and `baseline` (N, FUTURE, 2), in one frame.
    """
    off = np.linalg.norm(paths - future[:, None], axis=3)  # (N, K, FUTURE)
    everyone = np.arange(len(off))
    likeliest = off[everyone, probabilities.argmax(axis=1)]
    only = off[everyone, find_medoid(paths, probabilities)]
    plain = np.linalg.norm(baseline - future, axis=2)
    return {
        "minADE_1": likeliest.mean(axis=1),
        "minFDE_1": likeliest[:, -1],
        "minADE_K": off.mean(axis=2).min(axis=1),
        "minFDE_K": off[..., -1].min(axis=1),
        "single_ADE": only.mean(axis=1),
        "single_FDE": only[:, -1],
        "constant_velocity_ADE": plain.mean(axis=1),
        "constant_velocity_FDE": plain[:, -1],
    }


def _means(errors: Mapping[str, Array]) -> PathErrors | None:
    if not len(errors["minFDE_1"]):
        return None
    means = {name: float(error.mean()) for name, error in errors.items()}
    plain = means["constant_velocity_FDE"]

    def missed(name: str) -> float:
        return float((errors[name] > MISS_M).mean())

    def ratio(name: str) -> float | None:
        return means[name] / plain if plain else None

    return PathErrors(
        samples=len(errors["minFDE_1"]),
        **means,
        miss_rate_1=missed("minFDE_1"),
        miss_rate_K=missed("minFDE_K"),
        miss_rate_single=missed("single_FDE"),
        miss_rate_constant_velocity=missed("constant_velocity_FDE"),
        ratio_1=ratio("minFDE_1"),
        ratio_K=ratio("minFDE_K"),
        ratio_single=ratio("single_FDE"),
    )


NUMBERS = {
    "single path FDE m": "single_FDE",
    "best mode FDE m": "minFDE_K",
    "constant velocity FDE m": "constant_velocity_FDE",
}


class TrajectoryOutcomes:
    """Measure of the trajectory task: 1 / (1 + (minFDE_1 + minFDE_K) / 2), errors in metres."""

    measure_name = "1 / (1 + FDE in m)"
    redraws = REDRAWS

    def describe_targets(self, config: TrajectoryConfig) -> str:
        """Return the road users of a network's forecasts, and the number of its modes, in words."""
        whose = f"vehicles within {SEEN_M:g} m of the one with cameras" if config.cameras else "all vehicles"
        return f"paths of {whose}, in {config.modes} modes"

    def share_targets(self, configs: Sequence[TrajectoryConfig]) -> TrajectoryConfig:
        """Return the first configuration with the fewest modes, and with cameras where any network has them."""
        cameras = next((config.cameras for config in configs if config.cameras), None)
        return replace(configs[0], modes=min(config.modes for config in configs), cameras=cameras)

    def outcomes(
        self,
        network: TrajectoryNetwork,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: TrajectoryConfig | None = None,
    ) -> Outcomes:
        """Return the displacement errors of each sample [m], see `compute_errors`.

        asked: a configuration whose samples and number of modes (the likeliest ones) are tested; None: that of the
        network.
        """
        config = network.config
        wanted = asked or config
        cameras = wanted.cameras and (config.cameras or wanted.cameras)
        samples = samples_of(data, replace(config, cameras=cameras), frames)
        samples = Samples(data, samples.columns, config.cameras)
        paths, probabilities = predict_paths(network, samples, progress)
        if wanted.modes < config.modes:
            likeliest = np.argsort(-probabilities, axis=1, kind="stable")[:, : wanted.modes]
            paths = np.take_along_axis(paths, likeliest[:, :, None, None], axis=1)
            probabilities = np.take_along_axis(probabilities, likeliest, axis=1)
        columns = samples.columns
        future = columns.future.astype(np.float64)
        errors = compute_errors(paths, probabilities, future, constant_velocity(columns.past))
        return Outcomes(np.asarray(columns.scene, dtype=np.str_), errors)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the score of each bootstrap sample."""
        likeliest, best = (weighted_mean(outcomes.arrays[name], times) for name in ("minFDE_1", "minFDE_K"))
        return 1 / (1 + (likeliest + best) / 2)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return mean final errors [m], the miss rate of the single path, and the number of samples."""
        errors = outcomes.arrays
        means = {name: float(errors[column].mean()) for name, column in NUMBERS.items()}
        return {
            **means,
            "missed": float((errors["single_FDE"] > MISS_M).mean()),
            "road users": float(len(outcomes.scene)),
        }


def register_path_errors(
    network: TrajectoryNetwork, data: Dataset, samples: Samples, progress: Report = ignore_progress
) -> Registry:
    """Return the first miss of each road user and scene: a single path with a final error above `MISS_M`.

    Its position is that of the road user at the present, on the ground of the town.
    """
    columns = samples.columns
    paths, probabilities = predict_paths(network, samples, progress)
    ends = paths[np.arange(len(paths)), find_medoid(paths, probabilities), -1]
    wrong = np.linalg.norm(ends - columns.future[:, -1], axis=1) > MISS_M
    town = data.town()
    traces: dict[str, Trace | None] = {scene: data.trace(scene) for scene in np.unique(columns.scene).tolist()}
    misses: dict[int, list[PerceptionError]] = {}
    for row in np.flatnonzero(wrong):
        scene, actor = str(columns.scene[row]), int(columns.actor[row])
        trace = traces[scene]
        assert trace is not None  # the samples come from it
        x, y, _ = columns.pose[row].tolist()
        z, label = 0.0 if town is None else town.ground(x, y), str(trace.category[actor])
        misses.setdefault(int(columns.frame[row]), []).append(
            PerceptionError(
                *(x, y, z, 1.0, FINAL_ERROR, label, 0, float("nan"), scene, str(trace.actor[actor])),
                distance_m=measure_distance(data.world_from_agent(int(columns.frame[row])), x, y),
            )
        )
    return Registry.of(misses)
