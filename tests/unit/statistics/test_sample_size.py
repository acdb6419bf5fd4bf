"""Numbers of trainings and scenes that tell an effect, against simulated runs and a search of all pairs."""

import numpy as np
import pytest
from scipy import stats

from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.power import MOST_SCENES, SampleSize, plan_sample, power_of_one, power_of_seeds, seeds_to_tell
from flcav.statistics.seeds import (
    OWN_SCENES,
    MeanOverSeeds,
    OneTraining,
    SharedScenes,
    mean_over_seeds,
    of_one_training,
)

LEVEL = 0.05 / 6
LIMITED = (0.04, 0.021, 0.02, 30)  # effect, sd of trainings, of 30 scenes: neither alone tells it


def one(effect: float, sd: float, of_scenes: float, scenes: int, spread_of: int = 9) -> OneTraining:
    half = float(stats.norm.ppf(0.975)) * of_scenes
    found = of_one_training(Estimate(effect, effect - half, effect + half), scenes, Spread(sd, spread_of))
    assert found is not None
    return found


def simulated_power(effect: float, sd: float, of_scene: float, size: tuple[int, int], level: float) -> float:
    """Return how often runs of `size` (trainings, scenes) decide; `of_scene`: standard deviation of one scene."""
    rng, (trainings, scenes), times = np.random.default_rng(0), size, 4000
    values = effect + rng.normal(0, sd, (times, trainings))
    met = rng.normal(0, of_scene, (times, scenes))
    means = values.mean(axis=1) + met.mean(axis=1)
    sds, shared = values.std(axis=1, ddof=1), met.std(axis=1, ddof=1) / np.sqrt(scenes)
    told = 0
    for mean, own, common in zip(means, sds, shared, strict=True):
        p = MeanOverSeeds(mean, None, None, trainings, own, SharedScenes(common, scenes)).p_value()
        told += p is not None and p <= level
    return told / times


@pytest.mark.parametrize("asked", [LIMITED, (0.073, 0.017, 0.0255, 30), (0.03, 0.04, 0.004, 12)])
def test_runs_of_the_planned_size_decide_four_times_of_five(asked: tuple[float, float, float, int]) -> None:
    effect, sd, of_scenes, scenes = asked
    found = plan_sample(one(*asked), 0.0, LEVEL)
    assert found is not None
    assert found.trainings is not None
    assert found.scenes is not None
    size = found.trainings, found.scenes
    assert simulated_power(effect, sd, of_scenes * np.sqrt(scenes), size, LEVEL) == pytest.approx(0.81, abs=0.035)


def test_of_all_pairs_it_is_one_with_the_fewest_tests_of_a_scene() -> None:
    effect, sd, of_scenes, scenes = LIMITED
    found = plan_sample(one(*LIMITED), 0.0, LEVEL)
    assert found is not None
    products = []
    for trainings in range(2, 40):
        for each in range(scenes, 200):
            shared = SharedScenes(of_scenes * np.sqrt(scenes / each), each)
            if power_of_seeds(effect, sd, trainings, LEVEL, shared) >= 0.8:
                products.append(trainings * each)
                break
    assert found.trainings is not None
    assert found.scenes is not None
    assert min(products) <= found.trainings * found.scenes <= 1.05 * min(products)
    assert not found.by_trainings
    assert power_of_seeds(effect, sd, 10**6, LEVEL, SharedScenes(of_scenes, scenes)) < 0.8
    assert not found.by_scenes


def test_one_training_decides_as_often_as_simulated() -> None:
    rng, times, (effect, sd, of_scenes, spread_of) = np.random.default_rng(1), 40_000, (0.09, 0.02, 0.012, 9)
    seen = effect + rng.normal(0, sd, times) + rng.normal(0, of_scenes, times)
    estimated = rng.normal(0, sd, (times, spread_of)).std(axis=1, ddof=1)
    limit = np.hypot(stats.norm.ppf(1 - LEVEL / 2) * of_scenes, stats.t.ppf(1 - LEVEL / 2, spread_of - 1) * estimated)
    told = float(np.mean(np.abs(seen) > limit))
    assert power_of_one(effect, sd, spread_of, LEVEL, of_scenes) == pytest.approx(told, abs=0.01)
    assert power_of_one(0.01, 0.0, spread_of, LEVEL, 0.0) == 1.0


def test_one_training_on_more_scenes_may_do() -> None:
    found = plan_sample(one(0.12, 0.01, 0.05, 10), 0.0, LEVEL)
    assert found is not None
    assert found.trainings == 1
    assert found.scenes is not None
    assert found.scenes > 10
    assert found.by_scenes
    own = 0.05 * np.sqrt(10 / found.scenes)
    assert power_of_one(0.12, 0.01, 9, LEVEL, own) >= 0.8 > power_of_one(0.12, 0.01, 9, LEVEL, own * 1.1)
    assert found.describe("trainings").startswith(f"about 1 training on {found.scenes} scenes (no number of trainings")


def test_trainings_at_hand_count_and_scenes_at_hand_may_do() -> None:
    values = [0.05, -0.03, 0.06, 0.01, 0.02]
    mean = mean_over_seeds(values, shared=SharedScenes(0.002, 40))
    found = plan_sample(mean, 0.0, 0.05)
    assert found is not None
    assert found.scenes == 40
    assert found.trainings == seeds_to_tell(mean)
    assert found.trainings is not None
    assert found.trainings > 5
    assert (found.by_trainings, found.by_scenes) == (True, False)
    said = f"about {found.trainings} seeds on these 40 scenes (no number of scenes does for these 5 seeds)"
    assert found.describe("seeds") == said


def test_a_share_is_planned_on_the_scale_of_its_test() -> None:
    values, shared = [0.95, 0.97, 0.93], SharedScenes(0.004, 20)
    share, plain = (
        plan_sample(mean_over_seeds(values, shared=shared, share=each), 0.93, 0.05) for each in (True, False)
    )
    assert share is not None
    assert plain is not None
    assert share.trainings is not None
    assert plain.trainings is not None
    assert share.trainings > plain.trainings, "near 1 a lower value is nearer, in units of the spread"


def test_there_is_no_plan_without_shared_scenes_or_a_spread_and_none_large_enough_for_no_effect() -> None:
    assert plan_sample(mean_over_seeds([0.1, 0.2]), 0.0, 0.05) is None
    assert plan_sample(mean_over_seeds([0.1], shared=SharedScenes(0.01, 9)), 0.0, 0.05) is None
    assert mean_over_seeds([0.1, 0.2]).shared is OWN_SCENES
    none = plan_sample(mean_over_seeds([0.1, -0.1, 0.00001], shared=SharedScenes(0.01, 9)), 0.0, 0.05)
    assert none is not None
    assert none.describe("trainings") == f"more than 1000 trainings on {MOST_SCENES} scenes"


def test_the_words_say_what_neither_alone_can_do() -> None:
    def said(now: tuple[int, int], by_trainings: bool, by_scenes: bool) -> str:
        return SampleSize(12, 90, now, by_trainings, by_scenes).describe("trainings")

    assert said((1, 30), True, True) == "about 12 trainings on 90 scenes"
    neither = (
        "about 12 trainings on 90 scenes (no number of trainings does on these 30 scenes, nor any number of scenes"
    )
    assert said((1, 30), False, False) == f"{neither} for one training)"
    assert said((8, 30), False, False) == f"{neither} for these 8 trainings)"
    assert said((1, 30), True, False) == "about 12 trainings on 90 scenes (no number of scenes does for one training)"
    assert said((8, 90), False, True).startswith(
        "about 12 trainings on these 90 scenes (no number of trainings does on"
    )
