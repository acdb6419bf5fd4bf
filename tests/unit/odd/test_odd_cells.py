"""Errors by cell: the measure of a part of the frames, failures in the path, poles that cover the errors."""

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import transform_points
from flcav.odd.cells import Trial, cells_of, find_failures, measure_cell, measure_cells
from flcav.odd.coverage import collect_runs, list_covered, load_report, merge_runs, write_cod, write_matrix, write_runs
from flcav.odd.domain import Domain, everything, read_domain
from flcav.odd.measure import measure_domain
from flcav.odd.scenery import Scenery
from flcav.perception.errors import FALSE_POSITIVE, MISS, PerceptionError
from flcav.perception.outcomes import Outcomes, Times, Values, weighted_mean


def mean(outcomes: Outcomes, times: Times) -> Values:
    """Return a measure of which every number is known: the mean of a score per frame."""
    return weighted_mean(outcomes.arrays["score"], times)


SCENES = np.array(["a", "a", "b", "b", "c"])
OUTCOMES = Outcomes(SCENES, {"score": np.array([0.2, 0.4, 0.6, 0.8, 1.0])})


def error(x: float, y: float, returns: int = 50, kind: str = MISS, track: str = "car1") -> PerceptionError:
    return PerceptionError(x, y, 1.0, 1.0, kind, "Car", returns, 0.0, "a", track)


def test_a_cell_is_measured_on_its_frames_with_an_interval_over_its_scenes():
    inside = np.array([False, True, True, False, False])
    found = measure_cell(mean, OUTCOMES, inside)
    assert found is not None
    assert found.mean == pytest.approx(0.5)
    assert (found.low, found.high) == pytest.approx((0.4, 0.6))  # of two scenes: one of them twice at either end


def test_tests_are_joined_as_if_they_were_one():
    from flcav.geometry import Boxes
    from flcav.perception.metrics import match
    from flcav.perception.objects.evaluate import CLASSES, HIDDEN, KEPT, join_outcomes
    from flcav.perception.objects.task import OBJECTS

    rng = np.random.default_rng(2)
    at = [
        np.c_[rng.uniform(0, 40, (3, 2)), np.full(3, 0.8), np.tile((4, 2, 1.6), (3, 1)), np.zeros(3)] for _ in range(5)
    ]
    truths = [Boxes.from_array(boxes, "Car") for boxes in at]
    found = [
        Boxes.from_array(boxes + rng.normal(0, 0.6, boxes.shape) * (1, 1, 0, 0, 0, 0, 0), "Car", rng.random(3))
        for boxes in at
    ]

    def outcomes(part: slice) -> Outcomes:
        arrays = {CLASSES: np.array(["Car"]), HIDDEN: np.array([0])}
        for key, (kind, overlap) in KEPT.items():
            matches = match(found[part], truths[part], [Boxes.empty()] * len(found[part]), overlap, kind)
            arrays |= {f"Car/{key}/{field}": value for field, value in vars(matches).items()}
        return Outcomes(np.array(["a"] * len(found[part])), arrays)

    whole, joined = outcomes(slice(0, 5)), join_outcomes([outcomes(slice(0, 2)), outcomes(slice(2, 5))])
    times = rng.integers(0, 3, (20, 5))
    np.testing.assert_allclose(OBJECTS.measure(joined, times), OBJECTS.measure(whole, times))
    assert joined.scene.tolist() == ["0/a"] * 2 + ["1/a"] * 3


def test_one_scene_gives_no_interval_and_no_frame_no_measure():
    alone = measure_cell(mean, OUTCOMES, SCENES == "c")
    assert alone is not None
    assert (alone.mean, alone.low) == (1.0, None)
    assert measure_cell(mean, OUTCOMES, np.zeros(5, np.bool_)) is None


@pytest.mark.parametrize(
    ("ahead", "left", "returns", "kind", "fails"),
    [
        (20.0, 0.5, 20, MISS, True),
        (20.0, 0.5, 19, MISS, False),
        (20.0, 2.5, 50, MISS, False),
        (-5.0, 0.0, 50, MISS, False),
        (1.0, 0.0, 50, MISS, True),
        (41.0, 0.0, 50, MISS, False),
        (20.0, 0.0, 50, FALSE_POSITIVE, False),
    ],
)
def test_a_failure_is_a_certain_miss_in_the_path(
    drive: Dataset, ahead: float, left: float, returns: int, kind: str, fails: bool
):
    x, y, _ = transform_points(drive.world_from_agent(2), np.array([[ahead, left, 0.0]]))[0].tolist()
    assert find_failures(drive, {2: [error(x, y, returns, kind)]}) == {2: fails}


def test_the_pole_nearest_to_a_cells_errors_covers_them(ring: Scenery):
    pole = ring.town.poles
    x, y = pole.position[2, :2]
    ahead = (np.cos(pole.yaw[2]), np.sin(pole.yaw[2]))
    errors = [error(x + d * ahead[0], y + d * ahead[1], track=f"car{d}") for d in (6, 8, 10)]
    found = {number: errors if number == 0 else [] for number in range(5)}
    cells = {number: ("here",) if number < 2 else ("there",) for number in range(5)}
    failures = dict.fromkeys(range(5), False) | {0: True}
    tested = [Trial(ring.town, cells, found, failures)]
    first, second = measure_cells(mean, OUTCOMES, tested, 40.0)
    assert (first.cell, first.frames, first.errors, first.misses, first.failures) == (("here",), 2, 3, 3, 1)
    assert first.pole is not None
    assert (first.pole.town, first.pole.covered) == ("ring", 3)
    assert (second.errors, second.pole) == (0, None)


def test_of_errors_in_two_places_one_pole_covers_those_of_one(ring: Scenery):
    poles = ring.town.poles
    apart = np.linalg.norm(poles.position[:, None, :2] - poles.position[:, :2], axis=2)
    places = []
    for row, count in zip(np.unravel_index(apart.argmax(), apart.shape), (3, 2), strict=True):
        x, y = poles.position[row, :2] + 6.0 * np.array([np.cos(poles.yaw[row]), np.sin(poles.yaw[row])])
        places += [error(x, y, track=f"car{row}-{number}") for number in range(count)]
    tested = [Trial(ring.town, {0: ("here",)}, {0: places}, {0: False})]
    (row,) = measure_cells(mean, Outcomes(SCENES[:1], {"score": np.ones(1)}), tested, 40.0)
    assert row.pole is not None
    assert (row.errors, row.pole.covered) == (5, 3)


def test_the_cell_with_most_errors_per_frame_comes_first_and_no_pole_is_named_that_covers_none(ring: Scenery):
    far = [error(250.0 + number, 0.0, track=f"car{number}") for number in range(4)]
    found = {0: far[:1], 1: far[1:2], 2: far[2:3], 3: [], 4: far[3:]}  # 3 errors in 4 frames, 1 in 1
    cells = {number: ("many",) if number < 4 else ("dense",) for number in range(5)}
    tested = [Trial(ring.town, cells, found, dict.fromkeys(range(5), False))]
    rows = measure_cells(mean, OUTCOMES, tested, 40.0)
    assert [(row.cell, row.errors, row.frames, row.pole) for row in rows] == [
        (("dense",), 1, 1, None),
        (("many",), 3, 4, None),
    ]


def test_frames_are_in_the_cell_of_their_values(drive: Dataset, urban: Domain):
    measured = measure_domain(drive)
    cells = cells_of(urban, measured, ("junction", "speed_limit"))
    for (junction, limit), row in zip(cells, measured.rows(), strict=True):
        assert junction == row["junction"]
        low, high = (float(end) for end in limit.strip("[])").split(","))
        assert low <= float(row["speed_limit"] or -1) <= high
    with pytest.raises(InputError, match="did you mean 'junction'"):
        cells_of(urban, measured, ("juntion",))


def test_coverage_is_read_by_the_library_and_its_own_command(drive: Dataset, urban: Domain, tmp_path: Path):
    measured = measure_domain(drive)
    documents = collect_runs(urban, drive, measured, {measured.frames[0]: True})
    assert len(documents) == 4
    rows = {row.attribute: row for row in list_covered(merge_runs(list(documents.values())))}
    seen = {str(word) for word in measured.columns["junction"]}
    assert set(rows["scenery.junction"].covered) == seen & {"none", "t_junction", "crossroad", "roundabout"}
    assert rows["scenery.speed_limit"].outside == ("[55, 75)", "[75, 100)", "[100, 130]")  # at most 55 km/h
    write_runs(documents, tmp_path)
    assert load_report(tmp_path).runs == 4
    path = tmp_path / "matrix.html"
    axes = ("scenery.junction", "environment.light")
    write_matrix(list(documents.values()), *axes, "urban", ["4 runs & more"], path)
    page = path.read_text()
    assert "roundabout" in page
    assert "night" in page
    assert "<p>4 runs &amp; more</p>" in page
    assert page.startswith("<!")
    own = [sys.executable, "-c", "from openodd.report import main; raise SystemExit(main())", str(tmp_path / "runs")]
    told = subprocess.run(own, capture_output=True, text=True, check=True).stdout
    assert "scenery.junction" in told


@pytest.mark.parametrize(
    ("rule", "outside"),
    [
        ("ego_speed: '<= 50 km/h'", ["[50, 70)", "[70, 130]"]),
        ("ego_speed: '< 50 km/h'", ["[50, 70)", "[70, 130]"]),
        ("ego_speed: '<= 51 km/h'", ["[70, 130]"]),
        ("ego_speed: '>= 50 km/h'", ["[0, 5)", "[5, 30)", "[30, 50)"]),
        ("ego_speed: '[30 .. 50] km/h'", ["[0, 5)", "[5, 30)", "[50, 70)", "[70, 130]"]),
        ("rainfall: '<= 0 mm/h'", ["[0.3, 5)", "[5, 20)", "[20, 60]"]),  # dry is in the first
        ("lanes: '[1 .. 3] count'", []),  # 3 lanes are in the last
    ],
)
def test_a_bucket_that_only_begins_in_the_domain_is_outside(
    rule: str, outside: list[str], drive: Dataset, odd_file: Callable[[str], Path]
):
    domain = read_domain(odd_file(f"MODULES: {{m: {{INCLUDE_AND: {{{rule}}}}}}}"))
    document = next(iter(collect_runs(domain, drive, measure_domain(drive)).values()))
    items = document["items"]
    assert isinstance(items, list)
    (item,) = (each for each in items if isinstance(each, dict) and each["attribute"] == domain.tested[0])
    assert item["outside_odd"] == outside


def test_a_run_fails_at_its_first_failure_and_equal_recordings_give_equal_documents(drive: Dataset, urban: Domain):
    measured = measure_domain(drive)
    failing = {measured.frames[3]: True, measured.frames[4]: True}
    documents = collect_runs(urban, drive, measured, failing)
    assert [each["outcome"]["passed"] for each in documents.values()].count(False) >= 1  # type: ignore[index,call-overload]
    again = collect_runs(urban, drive, measured, failing)
    assert json.dumps(documents) == json.dumps(again)


def test_a_cod_has_a_row_per_frame_that_says_what_was_measured(drive: Dataset, tmp_path: Path):
    measured = measure_domain(drive)
    documents = collect_runs(everything(), drive, measured)
    assert write_cod(documents, tmp_path) == len(measured)
    rows = [row for path in sorted(tmp_path.glob("*_cod.csv")) for row in csv.DictReader(path.open())]
    limits = sorted(float(row["scenery.speed_limit;km/h"]) for row in rows)
    assert limits == sorted(measured.columns["speed_limit"].tolist())
    latitude = [float(row["SPATIAL_EXTENT"].split()[0]) for row in rows]
    assert all(abs(each - 49.0) < 0.01 for each in latitude)
    assert len(list(tmp_path.glob("*_cod_manifest.csv"))) == 4
