"""Intervals and pairs of a run's figures, worked out anew from kept outcomes by a few lines of NumPy."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, logit

from flcav.config import InputError
from flcav.perception.outcomes import Outcomes, compute_interval, compute_measure, difference
from flcav.perception.tasks import task_named
from flcav.runs.analysis.differences import collect_test, list_differences
from flcav.runs.analysis.histories import gaps_closed
from flcav.runs.arms import name_repeat
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.runs.results import tests as results
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.results.training import StageResult, Watched
from flcav.runs.stages import testing
from flcav.runs.stages.testing import RoundsSettings, rounds_step
from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.streams import stream

WEATHER = task_named("weather")
SCENES, PICTURES = 12, 20
NAMES = np.repeat([f"ring-0-{scene:02}" for scene in range(SCENES)], PICTURES)
HARD = np.random.default_rng(0).uniform(0.4, 0.9, (SCENES, 1))  # scenes differ much more than the networks do
TABLE = Spread(0.02, 9)
Right = NDArray[np.bool_]  # (SCENES * PICTURES,) pictures that are named rightly


def named(seed: int, gain: float = 0.0) -> Right:
    """Return which pictures are named rightly, by the same luck for all gains of a seed."""
    luck = np.random.default_rng(seed).random((SCENES, PICTURES))
    return (luck < HARD + gain).ravel()


def outcomes(right: Right, names: NDArray[Any] = NAMES) -> Outcomes:
    return Outcomes(names, {"truth": np.zeros(right.size, np.int64), "named": np.where(right, 0, 1)})


def redrawn(right: Right, seed: int) -> NDArray[np.float64]:
    """Return the accuracy of each bootstrap sample of the scenes."""
    draws = stream(seed, "bootstrap").multinomial(SCENES, np.full(SCENES, 1 / SCENES), size=1000)
    return draws @ right.reshape(SCENES, PICTURES).mean(axis=1) / SCENES


def ends(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.quantile(values, (0.025, 0.975))
    return low, high


def test_a_difference_has_the_interval_of_both_networks_on_the_same_draws() -> None:
    before, after = named(1), named(1, 0.05)
    mean, *found = difference(WEATHER, outcomes(before), outcomes(after), seed=7)
    interval = ends(redrawn(after, 7) - redrawn(before, 7))
    assert mean == pytest.approx(after.mean() - before.mean())
    assert mean > 0
    assert found == pytest.approx(interval)
    apart = ends(redrawn(after, 7) - redrawn(before, 8))
    assert apart[1] - apart[0] > 3 * (interval[1] - interval[0]), "what scenes do to both cancels only in pairs"


def test_there_is_no_interval_of_one_scene_and_no_difference_of_other_frames() -> None:
    one = np.repeat(["ring-0-0"], NAMES.size)
    assert difference(WEATHER, outcomes(named(1), one), outcomes(named(2), one))[1:] == (None, None)
    assert compute_interval(WEATHER, outcomes(named(1), one)) == (None, None)
    two = np.where(np.arange(NAMES.size) < 9, "ring-0-0", "ring-0-1")
    assert None not in difference(WEATHER, outcomes(named(1), two), outcomes(named(2), two))
    assert None not in compute_interval(WEATHER, outcomes(named(1), two))
    with pytest.raises(InputError, match="not of the same frames"):
        difference(WEATHER, outcomes(named(1)), outcomes(named(2), NAMES[::-1]))


def test_a_measure_has_the_interval_of_its_scenes() -> None:
    right = named(3)
    assert compute_measure(WEATHER, outcomes(right)) == pytest.approx(right.mean())
    assert compute_interval(WEATHER, outcomes(right), 5) == pytest.approx(ends(redrawn(right, 5)))


class Names:
    """Names of steps, each of its own."""

    def stage(self, arm: str, stage: str, region: str, task: str) -> str:
        return f"{PRETRAIN}-{task}" if stage == PRETRAIN else f"{stage}-{arm}-{'' if stage == CLOUD else region}"

    def test(self, trained: str, region: str) -> str:
        return f"test-{trained}-{region}"


def arm(name: str, stages: Sequence[str], regions: Sequence[str] = ("ring",), repeat: int = 0) -> SimpleNamespace:
    return SimpleNamespace(name=name, stages=stages, regions=regions, repeat=repeat, central=None)


def graph_of(
    arms: Sequence[SimpleNamespace], spreads: Any = None, retrainings: int = 0, primary: Sequence[str] = ()
) -> Any:
    regions = ("suburb", "ring", "far")

    def tested(own: SimpleNamespace) -> list[tuple[str, str, str]]:
        found = [(PRETRAIN, region, "weather") for region in regions] if own.name == MAIN else []
        places = {stage: regions if stage == CLOUD else own.regions for stage in own.stages}
        return found + [(stage, region, "weather") for stage, where in places.items() for region in where]

    return SimpleNamespace(
        names=Names(),
        settings={each.name: each for each in arms},
        tested=tested,
        spreads=spreads or {},
        recipe=SimpleNamespace(seed=7, retrainings=retrainings, primary_claims=primary),
    )


def save_test(work: Path, step: str, right: Right) -> Path:
    (work / step).mkdir(parents=True)
    found = outcomes(right)
    found.save(work / step / OUTCOMES)
    interval = Estimate(float(right.mean()), *compute_interval(WEATHER, found, 7))
    results.Tested("ring", "weather", "accuracy", interval, {}, right.size, SCENES).save(work / step)
    return work / step


def test_a_test_of_one_training_is_widened_by_the_spread_of_its_own_figure(tmp_path: Path) -> None:
    right = named(1, 0.1)
    save_test(tmp_path, "test-edge-main-ring-ring", right)
    spreads = {
        ("weather", "ring", MAIN, EDGE, "", ""): TABLE,
        ("weather", "ring", MAIN, EDGE, MAIN, PRETRAIN): Spread(0.3, 9),
        ("weather", "ring", MAIN, CLOUD, "", ""): Spread(0.3, 9),
    }
    found = collect_test(graph_of([], spreads), tmp_path, MAIN, EDGE, "ring", "weather")
    p, alone = right.mean(), np.array(ends(redrawn(right, 7)))
    trained = stats.t.ppf(0.975, 8) * 0.02 / (p * (1 - p))
    low, high = logit(p) + np.array([-1, 1]) * np.hypot(logit(alone) - logit(p), trained)
    assert (found.estimate.low, found.estimate.high) == pytest.approx((expit(low), expit(high)))
    assert found.spread == TABLE
    unknown = collect_test(graph_of([]), tmp_path, MAIN, EDGE, "ring", "weather")
    assert unknown.spread is None
    assert (unknown.estimate.low, unknown.estimate.high) == pytest.approx(tuple(alone))


def test_a_difference_of_one_training_is_widened_by_the_spread_of_its_own(tmp_path: Path) -> None:
    before, after = named(1), named(2, 0.05)
    save_test(tmp_path, f"test-{PRETRAIN}-weather-ring", before)
    save_test(tmp_path, "test-edge-main-ring-ring", after)
    spreads = {
        ("weather", "ring", MAIN, EDGE, MAIN, PRETRAIN): TABLE,
        ("weather", "ring", MAIN, EDGE, "", ""): Spread(0.3, 9),
    }
    for known in (spreads, {}):
        graph = graph_of([arm(MAIN, [EDGE])], known)
        graph.tested = lambda own: [(PRETRAIN, "ring", "weather"), (EDGE, "ring", "weather")]
        (found,) = list_differences(graph, tmp_path)
        mean, alone = after.mean() - before.mean(), np.array(ends(redrawn(after, 7) - redrawn(before, 7)))
        trained = stats.t.ppf(0.975, 8) * 0.02 if known else 0.0
        wanted = mean + np.array([-1, 1]) * np.hypot(alone - mean, trained)
        assert (found.estimate.low, found.estimate.high) == pytest.approx(tuple(wanted))
        assert (found.over_scenes.low, found.over_scenes.high) == pytest.approx(tuple(alone))
        assert found.spread == (TABLE if known else None)


def test_a_run_of_several_trainings_has_their_mean_and_not_the_table_s_spread(tmp_path: Path) -> None:
    befores, afters = ([named(seed, gain) for seed in (1, 2)] for gain in (0.0, 0.1))
    for number, (before, after) in enumerate(zip(befores, afters, strict=True)):
        own = f"{MAIN}-again{number}" if number else MAIN
        save_test(tmp_path, f"test-pretrain-{own}-ring-ring", before)
        save_test(tmp_path, f"test-edge-{own}-ring-ring", after)
    wide = {("weather", "ring", MAIN, EDGE, *rest): Spread(0.3, 9) for rest in (("", ""), (MAIN, PRETRAIN))}
    graph = graph_of([arm(MAIN, [EDGE])], wide, retrainings=1)
    graph.names.stage = lambda arm, stage, region, task: f"{stage}-{arm}-{region}"
    graph.tested = lambda own: [(PRETRAIN, "ring", "weather"), (EDGE, "ring", "weather")]
    (found,) = list_differences(graph, tmp_path)
    gains = [after.mean() - before.mean() for before, after in zip(befores, afters, strict=True)]
    assert found.trainings == pytest.approx(gains)
    assert found.estimate.mean == pytest.approx(np.mean(gains))
    assert found.spread is not None
    assert (found.spread.sd, found.spread.trainings) == (pytest.approx(np.std(gains, ddof=1)), 2)
    test = collect_test(graph, tmp_path, MAIN, EDGE, "ring", "weather")
    assert test.trainings == pytest.approx([after.mean() for after in afters])
    assert test.spread is not None
    assert test.spread.sd == pytest.approx(np.std([after.mean() for after in afters], ddof=1))
    assert test.steps == ("test-edge-main-ring-ring", "test-edge-main-again1-ring-ring")
    for each in (found, test):
        assert each.over_trainings is not None
        assert each.over_trainings.shared.scenes == SCENES
        assert each.over_trainings.share == (each is test)
        own, common = each.over_trainings.sd**2 / 2, each.over_trainings.shared.sd**2
        freedom = (own + common) / (own + common / (SCENES - 1))
        scale = 1 / (each.estimate.mean * (1 - each.estimate.mean)) if each is test else 1.0
        half = stats.t.ppf(0.975, freedom) * np.sqrt(own + common) * scale
        middle = logit(each.estimate.mean) if each is test else each.estimate.mean
        wanted = middle + np.array([-1, 1]) * half
        assert (each.estimate.low, each.estimate.high) == pytest.approx(
            tuple(expit(wanted) if each is test else wanted)
        )


def test_a_stage_is_compared_with_the_one_before_it_and_the_run_with_each_arm(tmp_path: Path) -> None:
    arms = [
        arm(MAIN, [EDGE, CLOUD]),
        arm("further", [EDGE, MORE_EDGE]),
        arm("oracle", [CENTRAL]),
        arm("elsewhere", [EDGE], regions=["suburb"]),
        arm(f"{MAIN}-again1", [EDGE, CLOUD], repeat=1),
    ]
    graph = graph_of(arms)
    names = graph.names
    for own in arms:
        for stage, region, task in graph.tested(own):
            step = names.test(names.stage(own.name, stage, region, task), region)
            if not (tmp_path / step).exists():
                save_test(tmp_path, step, named(1))
    found = [
        (each.arm, each.stage, each.before_arm, each.before_stage, each.region)
        for each in list_differences(graph, tmp_path)
    ]
    assert sorted(found) == sorted(
        [
            (MAIN, EDGE, MAIN, PRETRAIN, "ring"),
            (MAIN, CLOUD, MAIN, EDGE, "ring"),
            (MAIN, CLOUD, MAIN, PRETRAIN, "suburb"),  # which does not federate: it has no stage II of its own
            (MAIN, CLOUD, MAIN, PRETRAIN, "far"),
            ("further", EDGE, "further", PRETRAIN, "ring"),
            (MAIN, EDGE, "further", EDGE, "ring"),
            ("further", MORE_EDGE, "further", EDGE, "ring"),
            (MAIN, CLOUD, "further", MORE_EDGE, "ring"),
            ("oracle", CENTRAL, "oracle", PRETRAIN, "ring"),
            (MAIN, EDGE, "oracle", CENTRAL, "ring"),
            ("elsewhere", EDGE, "elsewhere", PRETRAIN, "suburb"),  # the run has no stage II there to compare
        ]
    )


def test_a_gap_begins_at_the_arm_s_own_pretraining_where_it_has_one() -> None:
    means = {
        (MAIN, PRETRAIN): 0.4,
        ("longer", PRETRAIN): 0.5,
        ("longer", EDGE): 0.55,
        (MAIN, EDGE): 0.55,
        ("oracle", CENTRAL): 0.6,
    }
    tests = []
    for (name, stage), mean in means.items():
        found = results.Tested("grid", "objects", "AP50", Estimate(mean, None, None), {}, 96, 8)
        tests.append(results.Test(name, stage, "grid", "objects", "test", found, found.estimate, None))
    recipe: Any = SimpleNamespace(arms={"longer": arm("longer", []), "oracle": SimpleNamespace(central="federate")})
    recipe.arms["longer"].central = None
    closed = gaps_closed(tests, recipe)
    assert closed == {
        "grid, objects: edge FL": pytest.approx(0.75),
        "grid, objects: edge FL (longer)": pytest.approx(0.5),
    }


@pytest.mark.parametrize("retrainings", [0, 2])
def test_a_primary_claim_is_of_the_mean_over_regions_whose_scenes_are_independent(
    tmp_path: Path, retrainings: int
) -> None:
    where = ("ring", "far")
    for number, region in enumerate(where):
        save_test(tmp_path, f"test-{PRETRAIN}-weather-{region}", named(number))
        for repeat in range(1 + retrainings):
            name = name_repeat(MAIN, repeat)
            save_test(tmp_path, f"test-{EDGE}-{name}-{region}-{region}", named(10 * repeat + number + 5, 0.1))
    arms = [arm(MAIN, [EDGE], where)]
    key = ("weather", "ring and far", MAIN, EDGE, MAIN, PRETRAIN)
    graph = graph_of(arms, {key: TABLE}, retrainings, ("edge",))
    joint, *single = list_differences(graph, tmp_path)
    own = [each for each in single if each.region in where]
    assert (joint.region, joint.regions, joint.name[:12]) == ("ring and far", where, "ring and far")
    assert joint.trainings == pytest.approx(np.mean([each.trainings for each in own], axis=0))
    assert len(joint.trainings) == 1 + retrainings
    assert joint.estimate.low is not None
    assert joint.estimate.high is not None
    if retrainings:
        assert joint.over_trainings is not None
        shared = [each.over_trainings.shared for each in own if each.over_trainings is not None]
        assert joint.over_trainings.shared.sd == pytest.approx(np.linalg.norm([each.sd for each in shared]) / 2)
        assert joint.over_trainings.shared.scenes == 2 * SCENES
    else:
        below = [each.over_scenes.mean - (each.over_scenes.low or 0) for each in own]
        wide = np.hypot(np.linalg.norm(below) / 2, stats.t(8).ppf(0.975) * TABLE.sd)
        assert joint.estimate.mean - joint.estimate.low == pytest.approx(wide)
    assert len(list_differences(graph_of(arms, None, retrainings), tmp_path)) == len(single)


@pytest.mark.parametrize(("stage", "wanted"), [(EDGE, [1, 2, 3]), (PRETRAIN, [0])])
def test_every_round_is_validated_with_the_network_that_the_federation_would_end_with(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, stage: str, wanted: list[int]
) -> None:
    split = SimpleNamespace(data="data", vehicles=(4, 6))
    asked = []

    def load(task: Any, start: str, folder: Path, number: int, averaged: int, share: float) -> str:
        asked.append((start, folder, number, averaged, share))
        return f"round {number}"

    monkeypatch.setattr(testing.Frames, "open", lambda folder: split)
    monkeypatch.setattr(testing, "load_stage_network", lambda task, folder: "round 0")
    monkeypatch.setattr(testing, "load_round_network", load)
    monkeypatch.setattr(StageResult, "load", classmethod(lambda cls, folder: SimpleNamespace(rounds=3, kept=None)))
    monkeypatch.setattr(testing, "score_network", lambda task, network, data, frames: float(network[-1]) / 10)
    inputs = {name: tmp_path / name for name in ("start", "trained", "frames")}
    work: Any = SimpleNamespace(inputs=inputs, folder=tmp_path, report=lambda *about: None)
    named: Any = {name: name for name in inputs}
    rounds_step(work, RoundsSettings(task="weather", region="ring", stage=stage, averaged=2, share=0.3, **named))
    found = Watched.load(tmp_path)
    assert [(each.round, each.score) for each in found.rounds] == [(number, number / 10) for number in wanted]
    assert (found.stage, found.region, found.frames) == (stage, "ring", 2)
    assert asked == [("round 0", inputs["trained"], number, 2, 0.3) for number in wanted if number]
