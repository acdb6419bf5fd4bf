"""Power of t tests, and sample size determination: how many trainings and test scenes together detect an effect.

The variance of a mean over trainings that share their test scenes is sd² / trainings + s² / scenes: more of the one
does not reduce the other part. So there are effects that no number of trainings detects on the scenes at hand, and
others that no number of scenes detects with the trainings at hand. Numbers of both are sought for the tests of `seeds`,
at a power of 0.8: Student's t of several trainings or seeds, and for one training of known spread the test of
`OneTraining`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.special import chdtri, nctdtr, ndtr, ndtri, stdtrit

from flcav.interface.wording import plural
from flcav.statistics.seeds import LEVEL, OWN_SCENES, MeanOverSeeds, OneTraining, SharedScenes, standard_error

POWER = 0.8  # chance to detect an effect that a number of seeds is planned for
MOST_SEEDS = 1000  # that a plan of seeds is sought up to
MOST_SCENES = 10_000  # test scenes that are sought up to
QUANTILES = (np.arange(99) + 0.5) / 99  # of an estimated variance


def power_of_seeds(
    effect: float, sd: float, seeds: int, level: float = LEVEL, shared: SharedScenes = OWN_SCENES
) -> float:
    """Return the power of the two-sided t test of a mean of `effect` over seeds of standard deviation `sd`.

    It is that of the noncentral t distribution (Cohen, "Statistical Power Analysis for the Behavioral Sciences", 1988).
    """
    error, freedom = standard_error(sd, seeds, shared)
    if error == 0:
        return float(effect != 0)
    beyond, limit = abs(effect) / error, stdtrit(freedom, 1 - level / 2)
    missed, wrong_side = np.nan_to_num(nctdtr(freedom, beyond, [limit, -limit]))  # not a number where next to 0
    return float(1 - missed + wrong_side)


def plan_seeds(
    effect: float, sd: float, level: float = LEVEL, shared: SharedScenes = OWN_SCENES, power: float = POWER
) -> int | None:
    """Return the least number of seeds that detect `effect` with the given power; None for more than `MOST_SEEDS`.

    `sd` is the standard deviation over seeds of the effect: of differences, that of the paired differences.
    """
    least, most = 1, MOST_SEEDS
    if power_of_seeds(effect, sd, most, level, shared) < power:
        return None
    while most - least > 1:  # power rises with seeds
        middle = (least + most) // 2
        enough = power_of_seeds(effect, sd, middle, level, shared) >= power
        least, most = (least, middle) if enough else (middle, most)
    return most


def seeds_to_tell(mean: MeanOverSeeds, hypothesis: float = 0.0, level: float = LEVEL) -> int | None:
    """Return `plan_seeds` for an effect as large as the distance from `hypothesis`, if the spread is known."""
    if not mean.known:
        return None
    shared = SharedScenes(mean.slope * mean.shared.sd, mean.shared.scenes)
    return plan_seeds(mean.distance(hypothesis), mean.slope * mean.sd, level, shared)


def plan_scenes(effect: float, error: float, scenes: int, level: float = LEVEL / 2, power: float = POWER) -> int | None:
    """Return the number of scenes that detect an `effect` above 0 in a one-sided z test, with the given power.

    `level` is that of the test. `error` is the standard error over `scenes`, which falls with their square root. At
    least `scenes`; None for an effect of 0 or less, which no number of scenes detects.
    """
    if effect <= 0:
        return None
    return max(scenes, int(np.ceil(scenes * ((ndtri(1 - level) + ndtri(power)) * error / effect) ** 2)))


@dataclass(frozen=True)
class SampleSize:
    """Numbers of trainings and of test scenes that detect an effect together, and whether either alone can."""

    trainings: int | None  # by the fewest tests of a scene; None: more than `MOST_SEEDS` on `MOST_SCENES` scenes
    scenes: int | None
    now: tuple[int, int]  # trainings and scenes at hand
    by_trainings: bool  # some number of trainings detects it on the scenes at hand
    by_scenes: bool  # some number of scenes detects it with the trainings at hand

    def describe(self, word: str) -> str:
        """Return the numbers as text, and which of them alone cannot do; `word`: the plural of a training."""
        if self.trainings is None or self.scenes is None:
            return f"more than {MOST_SEEDS} {word} on {MOST_SCENES} scenes"
        trainings, scenes = self.now
        own = f"{self.trainings} {word if self.trainings > 1 else word[:-1]}"
        said = f"about {own} on {'these ' if self.scenes == scenes else ''}{plural(self.scenes, 'scene')}"
        cannot = [] if self.by_trainings else [f"no number of {word} does on these {scenes} scenes"]
        if not self.by_scenes:
            these = f"one {word[:-1]}" if trainings == 1 else f"these {trainings} {word}"
            cannot.append(f"{'nor any' if cannot else 'no'} number of scenes{'' if cannot else ' does'} for {these}")
        return f"{said} ({', '.join(cannot)})" if cannot else said


def plan_sample(mean: MeanOverSeeds, hypothesis: float, level: float) -> SampleSize | None:
    """Return the numbers that detect an effect as large as the distance of `mean` from `hypothesis`, at `level`.

    Both are at least those at hand. None where trainings do not share test scenes, or their spread is not known.
    """
    if not (mean.known and mean.shared.scenes):
        return None
    effect, own = mean.distance(hypothesis), SharedScenes(mean.slope * mean.shared.sd, mean.shared.scenes)
    of_trainings = [*_steps(mean.seeds, MOST_SEEDS, 1.04)]
    of_scenes = [*_steps(own.scenes, MOST_SCENES, 1.1)]

    def detects(trainings: int, scenes: int) -> bool:
        shared = SharedScenes(own.sd * float(np.sqrt(own.scenes / scenes)), scenes)
        return _power(mean, effect, level, trainings, shared) >= POWER

    endless_trainings = power_of_seeds(effect, 0.0, MOST_SEEDS, level, own) >= POWER
    endless_scenes = _power(mean, effect, level, mean.seeds, SharedScenes(0.0, MOST_SCENES)) >= POWER
    return SampleSize(
        *(_search(detects, of_trainings, of_scenes) or (None, None)),
        (mean.seeds, own.scenes),
        endless_trainings or any(detects(each, own.scenes) for each in of_trainings),
        endless_scenes or any(detects(mean.seeds, each) for each in of_scenes),
    )


def _search(
    detects: Callable[[int, int], bool], of_trainings: Sequence[int], of_scenes: Sequence[int]
) -> tuple[int, int] | None:
    """Return the trainings and scenes with the fewest tests of a scene, trainings times scenes, that detect the effect.

    The numbers to try rise; from the best pair of them both are lowered, one by one, while the effect is still
    detected.
    """
    best, least = None, float("inf")
    for trainings in of_trainings:
        for scenes in of_scenes:
            if trainings * scenes >= least:
                break
            if detects(trainings, scenes):
                best, least = (trainings, scenes), trainings * scenes
                break
    if best is None:
        return None
    trainings, scenes = best
    while scenes > of_scenes[0] and detects(trainings, scenes - 1):
        scenes -= 1
    while trainings > of_trainings[0] and detects(trainings - 1, scenes):
        trainings -= 1
    return trainings, scenes


def _steps(first: int, most: int, ratio: float) -> Iterator[int]:
    """Yield rising numbers from `first` up to `most`, each about `ratio` times the one before."""
    last = 0
    for power in count():
        number = max(int(np.ceil(first * ratio**power)), last + 1)
        if last and number > most:
            return
        yield number
        last = number


def _power(mean: MeanOverSeeds, effect: float, level: float, trainings: int, shared: SharedScenes) -> float:
    """Return the power of the test that a mean of so many trainings gets, on scenes of so much spread."""
    sd = mean.slope * mean.sd
    if isinstance(mean, OneTraining) and trainings == 1:
        return power_of_one(effect, sd, mean.trainings, level, shared.sd)
    return power_of_seeds(effect, sd, trainings, level, shared)


def power_of_one(effect: float, sd: float, trainings: int, level: float, of_scenes: float) -> float:
    """Return the power of the test of one training, whose spread `sd` was estimated from others.

    It is the mean over the distribution of that estimate, chi-squared, of the power with each. `of_scenes`: standard
    deviation of the number by its test scenes.
    """
    freedom = trainings - 1
    estimated = sd * np.sqrt(chdtri(freedom, QUANTILES) / freedom)
    limit = np.hypot(ndtri(1 - level / 2) * of_scenes, stdtrit(freedom, 1 - level / 2) * estimated)
    error = float(np.hypot(of_scenes, sd))
    if error == 0:
        return float(effect != 0)
    return float(np.mean(ndtr((abs(effect) - limit) / error) + ndtr((-abs(effect) - limit) / error)))
