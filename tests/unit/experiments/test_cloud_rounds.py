"""Tables of cloud rounds over retrainings: divergence beside gain, rank correlations, and scores by statistics."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from flcav.federation.state import Divergence, RoundDivergence
from flcav.report.cloud_rounds import cloud_tables, describe_correlation
from flcav.runs.recipe import CLOUD, EDGE, MAIN
from flcav.runs.results.training import FederatedRound, StageResult, StatisticsScore

GAINS = {"grid": (0.01, -0.02, 0.03, 0.0), "ring": (0.02, 0.0, 0.01, -0.01)}
BEGUN, TRAINED = (0.4, 0.3, 0.1, 0.2), (0.2, 0.1, 0.4, 0.3)


def stage(number: int, measured: bool) -> StageResult:
    divergence = RoundDivergence(
        Divergence(BEGUN[number], 0.5, BEGUN[number] ** 2), Divergence(TRAINED[number], 0.25 + number, 0.1)
    )
    kept = FederatedRound("cloud", 1, ("grid", "ring"), {}, 9, 0.5, 1, 1, None, None, divergence if measured else None)
    scores = tuple(
        StatisticsScore(region, 40, 0.5 + 0.01 * number, 0.5 + own * number)
        for region, own in (("grid", 0.03), ("ring", 0.0))
    )
    about: Any = {"rounds": 1, "samples": 9, "clients": 2, "poles": ()}
    return StageResult(CLOUD, "objects", None, **about, records=(kept,), statistics=scores if measured else None)


def run_of(measured: bool = True) -> Any:
    differences = [
        SimpleNamespace(
            arm=MAIN,
            stage=CLOUD,
            before_arm=MAIN,
            before_stage=EDGE,
            task="objects",
            region=region,
            over_scenes=SimpleNamespace(mean=gains[0]),
            retrained=gains[1:],
        )
        for region, gains in GAINS.items()
    ]
    first, *others = (stage(number, measured) for number in range(4))
    main = SimpleNamespace(stages=(first,), retrained=tuple(others))
    recipe = SimpleNamespace(tasks=["objects"], retrainings=3)
    return SimpleNamespace(recipe=recipe, arms={MAIN: main}, differences=differences)


def rank(values: Any) -> np.ndarray:
    return np.argsort(np.argsort(values))


def test_divergence_stands_beside_the_gain_with_its_rank_correlation() -> None:
    shown = cloud_tables(cast(Any, run_of()))["divergence"].splitlines()
    header = [cell.strip() for cell in shown[0].split("|")[2:-1]]
    assert header[:3] == ["whole, after edge FL", "learned, after edge FL", "statistics, after edge FL"]
    assert header[-3:] == ["grid: cloud - edge FL", "ring: cloud - edge FL", "mean gain"]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in shown[2:]]
    assert cells[1][0] == "objects, training 2"
    assert (cells[1][1], cells[1][4], cells[1][-1]) == ("0.3000", "0.1000", "-0.010")
    assert cells[4][0] == "mean"
    assert cells[4][1] == f"{np.mean(BEGUN):.4f}"
    gain = np.mean([*GAINS.values()], axis=0)  # .015, -.01, .02, -.005
    for column, values in ((1, BEGUN), (4, TRAINED)):
        rho = np.corrcoef(rank(values), rank(gain))[0, 1]
        assert cells[5][column].startswith(f"{rho:+.2f} (p ")
    assert cells[5][3] == ""  # the same statistics in all trainings


def test_p_values_of_rank_correlations_are_exact() -> None:
    """Of the 24 orders of four trainings 2 are perfect, 8 correlate by 0.8 or more, of either sign."""
    assert describe_correlation((1, 2, 3, 4), (5, 6, 7, 9)) == "+1.00 (p 0.08)"
    assert describe_correlation((1, 2, 3, 4), (5, 6, 9, 7)) == "+0.80 (p 0.33)"
    assert describe_correlation((1, 2, 3, 4, 5, 6, 7, 8), (1, 2, 3, 4, 5, 6, 7, 8)) == "+1.00 (p 0.00)"
    assert describe_correlation((1, 1, 1), (1, 2, 3)) == describe_correlation((1, 2), (1, 2)) == ""


def test_own_statistics_are_compared_in_each_training() -> None:
    shown = cloud_tables(cast(Any, run_of()))["statistics"].splitlines()
    gained = 0.02 * np.arange(4)
    told = f"{gained.mean():+.3f}, sd {gained.std(ddof=1):.3f}"
    assert shown[2] == f"| grid, objects | 4 | 40 | 0.515 | 0.545 | {told} |"
    assert shown[3].endswith("-0.015, sd 0.013 |")


def test_results_of_before_have_no_such_tables() -> None:
    assert cloud_tables(cast(Any, run_of(measured=False))) == {}
