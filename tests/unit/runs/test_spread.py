"""Tables of the spread of retraining: written, read back, and refused where they are none."""

import runpy
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.report.run_tables import tables
from flcav.runs.results.run import Run
from flcav.runs.spread import SpreadRow, figure_key, list_figures, list_spreads, read_spreads, widen_anew
from flcav.runs.tables import append_records
from flcav.statistics.estimates import Spread

ROOT = Path(__file__).parents[3]
RUNS = ROOT / "reproductions/runs"
GAIN = ("objects", "ring", "main", "edge", "main", "pretrain")  # what edge FL gains on ring
ROW = SpreadRow("objects", "grid", "main", "edge", "", "", sd=0.021, trainings=9, run="seed1")


def test_a_table_is_read_by_measure_and_by_difference(tmp_path: Path) -> None:
    append_records(tmp_path / "own.csv", [ROW, replace(ROW, before_arm="main", before_stage="pretrain", sd=0.015)])
    assert read_spreads("own.csv", tmp_path) == {
        ("objects", "grid", "main", "edge", "", ""): Spread(0.021, 9),
        ("objects", "grid", "main", "edge", "main", "pretrain"): Spread(0.015, 9),
    }


def test_runs_of_one_measure_are_pooled(tmp_path: Path) -> None:
    append_records(tmp_path / "own.csv", [ROW, replace(ROW, sd=0.04, trainings=3, run="seed2")])
    (pooled,) = read_spreads("own.csv", tmp_path).values()
    assert (pooled.sd, pooled.trainings) == (pytest.approx(((8 * 0.021**2 + 2 * 0.04**2) / 10) ** 0.5), 11)


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        ("wide,9,seed1", "row 1: sd and trainings must be numbers"),
        ("nan,9,seed1", "row 1: sd must be from 0 to 1"),
        ("0.1,1,seed1", "trainings 2 or more"),
        ("0.1,9", "row 1: column 'run' is missing"),
        ("0.1,9," + 200_000 * "x", "own.csv: not a CSV table .field larger than"),
    ],
)
def test_a_row_that_is_no_spread_is_named(tmp_path: Path, cells: str, said: str) -> None:
    header = ",".join(field.name for field in fields(SpreadRow))
    (tmp_path / "own.csv").write_text(f"{header}\nobjects,grid,main,edge,,,{cells}\n")
    with pytest.raises(InputError, match=said):
        read_spreads("own.csv", tmp_path)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"spread: 'none\.csv' is no spread of the package"):
        read_spreads("none.csv", tmp_path)


def test_the_package_s_table_is_that_of_the_retrainings_and_of_the_run_on_another_processor() -> None:
    tool = runpy.run_path(str(ROOT / "tools/ship_spreads.py"))
    measured = tool["measure"]([RUNS / "demo/earlier/retraining", RUNS / "demo/earlier/avx2"])
    assert len(measured) == 19
    assert read_spreads("demo", Path()) == {
        (row.task, row.region, row.arm, row.stage, row.before_arm, row.before_stage): Spread(round(row.sd, 5), 9)
        for row in measured
    }


def test_a_further_run_is_one_more_training_of_every_figure() -> None:
    run, further = (
        Run.load(RUNS / "demo/earlier/retraining", "results.json"),
        Run.load(RUNS / "demo/earlier/avx2", "results.json"),
    )
    own, more = list_spreads(run, "seed1"), list_spreads(run, "seed1", [further])
    assert [row.trainings for row in (*own, *more)] == [8] * 19 + [9] * 19
    place = list(list_figures(run)).index(GAIN)
    eight, ninth = list_figures(run)[GAIN].trainings, list_figures(further)[GAIN].trainings
    assert own[place].sd == pytest.approx(np.std(eight, ddof=1))
    assert more[place].sd == pytest.approx(np.std([*eight, *ninth], ddof=1))
    assert more[place].sd > 2.5 * own[place].sd


def test_pages_judge_a_run_by_the_present_table() -> None:
    run = Run.load(RUNS / "demo/earlier/road", "results.json")
    spreads = read_spreads("demo", Path())
    widened = widen_anew(run, spreads)
    for before, after in zip(run.differences, widened.differences, strict=True):
        assert after.spread == spreads[figure_key(after)]
        assert after.estimate.mean == before.estimate.mean
    for before, after in zip(run.tested, widened.tested, strict=True):
        assert after.result == before.result
        assert 0 < (after.estimate.low or 0) < after.estimate.mean < (after.estimate.high or 0) < 1
    assert tables(run)["findings"] == tables(widened)["findings"]
    without = widen_anew(run, {})
    assert all(each.spread is None and each.estimate == each.over_scenes for each in without.differences)


def test_the_page_of_another_processor_has_the_gains_by_its_own_pole_and_by_the_committed_run_s() -> None:
    page = (RUNS / "demo/README.md").read_text(encoding="utf-8")
    own, fixed = (Run.load(RUNS / "demo/earlier/avx2", name) for name in ("results.json", "results_pole4.json"))
    for run, poles, said in ((own, (2,), "edge FL gains 0.021"), (fixed, (4,), "edge FL gains 0.045")):
        (placed,) = [each for each in run.arms["main"].placed if each.region == "ring"]
        gain = list_figures(run)[GAIN].trainings[0]
        assert (tuple(placed.chosen), f"edge FL gains {gain:.3f}") == (poles, said)
        assert said in page
