"""Redundant tasks: shares in proportion to the rule's numbers, the same bytes by every split, scores and tables."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes
from flcav.reproductions.redundant_tasks.run import (
    ALL,
    LEAST,
    MOST,
    PRETRAINED_ONLY,
    RedundantTasksResult,
    Weighed,
    list_steps,
    mean_score,
    name_step,
    redundant_tasks_tables,
    summarise,
)
from flcav.reproductions.redundant_tasks.scenarios import (
    EVEN,
    REVERSED,
    RULE,
    SCENARIOS,
    SPLITS,
    TASKS,
    TOY,
    TriedScenario,
    draw_sweeps,
    outcomes_file,
    share_out,
    split_tasks,
    spread_frames,
)
from flcav.runs.engine import run_steps
from flcav.storage.records import from_json


@given(st.lists(st.integers(1, 4), min_size=2, max_size=4), st.integers(4, 12))
def test_shares_are_the_nearest_to_the_proportion(counts: list[int], total: int) -> None:
    """Webster's method minimises the sum of squared shares by count (Sainte-Laguë, 1910), here of shares of 1 on."""
    shares = share_out(counts, total)
    assert sum(shares) == total
    every = [each for each in product(range(1, total), repeat=len(counts)) if sum(each) == total]
    cost = [sum(share**2 / count for share, count in zip(each, counts, strict=True)) for each in every]
    assert sum(share**2 / count for share, count in zip(shares, counts, strict=True)) == pytest.approx(min(cost))


@given(st.lists(st.integers(1, 4), min_size=len(SCENARIOS), max_size=len(SCENARIOS)).map(sorted))
def test_every_split_has_as_many_tasks_and_more_where_it_is_complex(ascending: list[int]) -> None:
    splits = split_tasks(ascending[::-1])
    assert {sum(shares) for shares in splits.values()} == {TASKS}
    assert set(splits[EVEN]) == {TASKS // len(SCENARIOS)}
    assert list(splits[RULE]) == sorted(splits[RULE], reverse=True)
    assert splits[REVERSED] == splits[RULE][::-1]


def test_tested_frames_are_spread_over_the_recording() -> None:
    assert spread_frames(np.arange(100, 200), 3) in ([100, 150, 199], [100, 149, 199])
    assert spread_frames(np.array([5, 7]), 3) == [5, 7]


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[TriedScenario, ...]]:
    out = tmp_path_factory.mktemp("redundant")
    values = run_steps(list_steps((1,), TOY), out, jobs=1, notify=lambda *about: None)
    return out / name_step(1), from_json(tuple[TriedScenario, ...], values[name_step(1)], "step")


@pytest.mark.slow
def test_bytes_are_the_same_by_every_split(tried: tuple[Path, tuple[TriedScenario, ...]]) -> None:
    _, own = tried
    assert {(each.town, each.kind) for each in own} == set(SCENARIOS)
    assert [each.complexity.total for each in own] == sorted((each.complexity.total for each in own), reverse=True)
    assert all(each.complexity.errors > 0 for each in own), "a network of two steps errs everywhere"
    (update,) = {round(mb / int(count), 4) for each in own for count, mb in each.up_mb.items() if count != "0"}
    for split in SPLITS:
        assert sum(each.tasks[split] for each in own) == TASKS
        assert sum(each.up_mb[str(each.tasks[split])] for each in own) == pytest.approx(TASKS * update, rel=1e-3)
    assert all(each.up_mb["0"] == 0 for each in own)


@pytest.mark.slow
def test_scores_are_means_of_the_tests_of_each_scenario(tried: tuple[Path, tuple[TriedScenario, ...]]) -> None:
    folder, own = tried
    results = summarise({"1": own, "2": own}, {"1": folder, "2": folder})
    for split in SPLITS:
        ap = [each.ap50[str(each.tasks[split])] for each in own]
        scores = (float(np.mean(ap)), ap[0], ap[-1])
        assert tuple(results.ap50[score][split].mean for score in (ALL, MOST, LEAST)) == pytest.approx(scores)
    assert results.ap50[MOST][PRETRAINED_ONLY].mean == pytest.approx(own[0].ap50["0"])
    for name, difference in results.differences.items():
        split, _, score = name.partition(f" - {EVEN}, ")
        expected = results.ap50[score][split].mean - results.ap50[score][EVEN].mean
        assert difference.mean == pytest.approx(expected)
    assert RedundantTasksResult.from_json(results.as_json(), "results") == results
    assert results.picture().startswith(b"\x89PNG")
    tables = redundant_tasks_tables(results)
    assert tables["accuracy"].count("\n") == 1 + 1 + len(SPLITS)
    assert all(each.name in tables["scenarios"] for each in own)
    assert results.sentences()[0].startswith("uplink: even split ")


def made_outcomes(right: list[int]) -> Outcomes:
    """Return a frame per scene, each of one car, found where it is `right`, else there is a detection beside it."""
    count = len(right)
    matches: dict[str, Any] = {
        "score": np.linspace(0.9, 0.5, count),
        "hit": np.array(right, bool),
        "turned": np.zeros(count),
        "frame": np.arange(count),
        "targets": np.ones(count, int),
    }
    keys = ("3d50", "3d70", "bev50")
    arrays = {f"Car/{key}/{name}": column for key in keys for name, column in matches.items()}
    scenes = np.array([f"scene{number}" for number in range(count)])
    return Outcomes(scenes, {"classes": np.array(["Car"]), "hidden": np.zeros(1, int), **arrays})


def test_a_difference_is_paired_over_the_scenes_that_seeds_share() -> None:
    good, bad = made_outcomes([1, 1, 1, 1]), made_outcomes([1, 0, 1, 0])
    once = np.ones((1, 4), np.int64)
    gap = float(OBJECTS.measure(good, once)[0] - OBJECTS.measure(bad, once)[0])
    pair = [Weighed(good, 0.5, "ring"), Weighed(bad, -0.5, "ring")]
    found = mean_score([pair, pair])
    assert found.mean == pytest.approx(gap / 2)
    assert found.shared.scenes == 4
    assert found.shared.sd > 0
    same = mean_score([[Weighed(good, 1.0, "ring"), Weighed(good, -1.0, "ring")]] * 2)
    assert (same.mean, same.shared.sd) == (0.0, 0.0)


def test_a_scenario_needs_the_frames_of_its_tasks() -> None:
    frames = np.arange(50, 70)
    first = draw_sweeps(frames, 4, (1, "ring, roundabout"))
    assert draw_sweeps(frames, 9, (1, "ring, roundabout"))[:4] == first, "further tasks have further sweeps"
    assert draw_sweeps(frames, 4, (2, "ring, roundabout")) != first
    with pytest.raises(InputError, match="ring, roundabout: 20 frames were recorded there, and its tasks need 30"):
        draw_sweeps(frames, 30, (1, "ring, roundabout"))


@pytest.mark.slow
def test_outcomes_have_a_file_for_each_number_of_tasks(tried: tuple[Path, tuple[TriedScenario, ...]]) -> None:
    folder, own = tried
    for each in own:
        assert {*each.ap50} == {"0", *map(str, each.tasks.values())}
        assert all(outcomes_file(folder, each.town, each.kind, int(count)).is_file() for count in each.ap50)
