"""Power of t tests, and determination of sample size: numbers of trainings and test scenes that detect an effect.

The variance of a mean over trainings that share their test scenes is sd² / trainings + s² / scenes: more of the one
does not reduce the other part. Hence some effects are detected by no number of trainings on the scenes at hand, and
others by no number of scenes with the trainings at hand. Both numbers are determined for the tests of `seeds`, at a
power of 0.8: Student's t of several trainings or seeds, and the test of `OneTraining` for one training of known spread.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.special import chdtri, nctdtr, ndtr, ndtri, stdtrit

from flcav.interface.wording import plural
from flcav.statistics.seeds import LEVEL, OWN_SCENES, MeanOverSeeds, OneTraining, SharedScenes, standard_error

POWER = 0.8  # probability of detecting an effect, for which a number of seeds is planned
MOST_SEEDS = 1000  # largest number of seeds that is tried
MOST_SCENES = 10_000  # largest number of test scenes that is tried
QUANTILES = (np.arange(99) + 0.5) / 99  # of an estimated variance, over which the power is averaged


def power_of_seeds(
    effect: float, sd: float, seeds: int, level: float = LEVEL, shared: SharedScenes = OWN_SCENES
) -> float:
    """Return the power of the two-sided t test of a mean of `effect` over seeds of standard deviation `sd`.

    It is that of the noncentral t distribution (Cohen, "Statistical Power Analysis for the Behavioral Sciences", 1988).
    """
    error, freedom = standard_error(sd, seeds, shared)
    if error == 0:
        return float(effect != 0)
    beyond = abs(effect) / error
    limit = stdtrit(freedom, 1 - level / 2)
    missed, wrong_side = np.nan_to_num(nctdtr(freedom, beyond, [limit, -limit]))  # NaN where it is next to 0
    return float(1 - missed + wrong_side)


def plan_seeds(
    effect: float, sd: float, level: float = LEVEL, shared: SharedScenes = OWN_SCENES, power: float = POWER
) -> int | None:
    """Return the least number of seeds that detects `effect` with the given power; None for more than `MOST_SEEDS`.

    `sd` is the standard deviation of the effect over seeds: for differences, of the paired differences.
    """
    least = 1
    most = MOST_SEEDS
    if power_of_seeds(effect, sd, most, level, shared) < power:
        return None
    while most - least > 1:  # bisection, since power rises with the number of seeds
        middle = (least + most) // 2
        enough = power_of_seeds(effect, sd, middle, level, shared) >= power
        least, most = (least, middle) if enough else (middle, most)
    return most


def seeds_to_tell(mean: MeanOverSeeds, hypothesis: float = 0.0, level: float = LEVEL) -> int | None:
    """Return `plan_seeds` for an effect as large as the distance from `hypothesis`; None for an unknown spread."""
    if not mean.known:
        return None
    shared = SharedScenes(mean.slope * mean.shared.sd, mean.shared.scenes)
    return plan_seeds(mean.distance(hypothesis), mean.slope * mean.sd, level, shared)


def plan_scenes(effect: float, error: float, scenes: int, level: float = LEVEL / 2, power: float = POWER) -> int | None:
    """Return the number of scenes that detects an `effect` above 0 in a one-sided z test, with the given power.

    `level` is that of the test. `error` is the standard error over `scenes` scenes, proportional to the inverse of the
    square root of their number. At least `scenes`; None for an effect of 0 or less.
    """
    if effect <= 0:
        return None
    return max(scenes, int(np.ceil(scenes * ((ndtri(1 - level) + ndtri(power)) * error / effect) ** 2)))


@dataclass(frozen=True)
class SampleSize:
    """Numbers of trainings and of test scenes that together detect an effect, and whether either alone can."""

    trainings: int | None  # with the least product of both; None: more than `MOST_SEEDS` on `MOST_SCENES` scenes
    scenes: int | None
    now: tuple[int, int]  # numbers of trainings and scenes at hand
    by_trainings: bool  # whether some number of trainings detects it on the scenes at hand
    by_scenes: bool  # whether some number of scenes detects it with the trainings at hand

    def tell(self, word: str) -> str:
        """Return both numbers as text; `word`: the plural of a training."""
        if self.trainings is None or self.scenes is None:
            return f"more than {MOST_SEEDS} {word} on {MOST_SCENES} scenes"
        needed = f"{self.trainings} {word if self.trainings > 1 else word[:-1]}"
        return f"about {needed} on {'these ' if self.scenes == self.now[1] else ''}{plural(self.scenes, 'scene')}"

    def describe(self, word: str) -> str:
        """Return the numbers as text, and which of them does not suffice alone; `word`: the plural of a training."""
        text = self.tell(word)
        if self.trainings is None or self.scenes is None:
            return text
        trainings, scenes = self.now
        cannot = [] if self.by_trainings else [f"no number of {word} does on these {scenes} scenes"]
        if not self.by_scenes:
            these = f"one {word[:-1]}" if trainings == 1 else f"these {trainings} {word}"
            cannot.append(f"{'nor any' if cannot else 'no'} number of scenes{'' if cannot else ' does'} for {these}")
        return f"{text} ({', '.join(cannot)})" if cannot else text


def plan_sample(mean: MeanOverSeeds, hypothesis: float, level: float) -> SampleSize | None:
    """Return the numbers that detect an effect as large as the distance of `mean` from `hypothesis`, at `level`.

    Neither is smaller than that at hand. None where trainings do not share test scenes, or their spread is not known.
    """
    if not (mean.known and mean.shared.scenes):
        return None
    effect = mean.distance(hypothesis)
    at_hand = SharedScenes(mean.slope * mean.shared.sd, mean.shared.scenes)
    of_trainings = [*_steps(mean.seeds, MOST_SEEDS, 1.04)]
    of_scenes = [*_steps(at_hand.scenes, MOST_SCENES, 1.1)]

    def detects(trainings: int, scenes: int) -> bool:
        shared = SharedScenes(at_hand.sd * float(np.sqrt(at_hand.scenes / scenes)), scenes)
        return _power(mean, effect, level, trainings, shared) >= POWER

    # In the limit of endless trainings only the scenes' part of the variance remains, and the reverse.
    endless_trainings = power_of_seeds(effect, 0.0, MOST_SEEDS, level, at_hand) >= POWER
    endless_scenes = _power(mean, effect, level, mean.seeds, SharedScenes(0.0, MOST_SCENES)) >= POWER
    return SampleSize(
        *(_search(detects, of_trainings, of_scenes) or (None, None)),
        (mean.seeds, at_hand.scenes),
        endless_trainings or any(detects(trainings, at_hand.scenes) for trainings in of_trainings),
        endless_scenes or any(detects(mean.seeds, scenes) for scenes in of_scenes),
    )


def _search(
    detects: Callable[[int, int], bool], of_trainings: Sequence[int], of_scenes: Sequence[int]
) -> tuple[int, int] | None:
    """Return the trainings and scenes of least product that detect the effect; None where none of the numbers do.

    Candidates ascend; from their best pair both numbers are reduced one by one while the effect is still detected.
    """
    best = None
    least = float("inf")
    for trainings in of_trainings:
        for scenes in of_scenes:
            if trainings * scenes >= least:
                break
            if detects(trainings, scenes):
                best = (trainings, scenes)
                least = trainings * scenes
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
    """Yield ascending numbers from `first` up to `most`, each about `ratio` times the one before."""
    last = 0
    for power in count():
        number = max(int(np.ceil(first * ratio**power)), last + 1)
        if last and number > most:
            return
        yield number
        last = number


def _power(mean: MeanOverSeeds, effect: float, level: float, trainings: int, shared: SharedScenes) -> float:
    """Return the power of the test of a mean over `trainings`; `shared` is the part of the spread by test scenes."""
    sd = mean.slope * mean.sd
    if isinstance(mean, OneTraining) and trainings == 1:
        return power_of_one(effect, sd, mean.trainings, level, shared.sd)
    return power_of_seeds(effect, sd, trainings, level, shared)


def power_of_one(effect: float, sd: float, trainings: int, level: float, of_scenes: float) -> float:
    """Return the power of the test of one training, whose spread `sd` was estimated from others.

    The power is averaged over the distribution of that estimate, a scaled chi distribution. `of_scenes`: standard
    deviation of the number over test scenes.
    """
    freedom = trainings - 1
    estimated = sd * np.sqrt(chdtri(freedom, QUANTILES) / freedom)
    limit = np.hypot(ndtri(1 - level / 2) * of_scenes, stdtrit(freedom, 1 - level / 2) * estimated)
    error = float(np.hypot(of_scenes, sd))
    if error == 0:
        return float(effect != 0)
    return float(np.mean(ndtr((abs(effect) - limit) / error) + ndtr((-abs(effect) - limit) / error)))
