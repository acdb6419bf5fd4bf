"""Prediction of runs that a learning curve was not fitted to."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import spearmanr

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.held_out import (
    attainable_correlation,
    hold_out_runs,
    measure_pure_error,
    noise_of_runs,
)
from flcav.optimization.curves.history import History
from flcav.optimization.curves.levels import Levelled, level_seeds

COUNTS = np.array([(s, e, 0) for s in (40, 80, 160, 320) for e in range(4)], dtype=float)
RUNS = tuple(f"n{int(samples)}" for samples, _, _ in COUNTS)


def history(noise: float) -> History:
    error = 1.5 * COUNTS[:, 0] ** -0.4 + 0.3 * (COUNTS[:, 1] + 1) ** -0.8
    drawn = np.random.default_rng(1).normal(scale=noise, size=len(COUNTS))
    return History(COUNTS, 1 - error + drawn, np.ones(len(COUNTS)), RUNS)


@pytest.mark.slow
def test_a_run_is_predicted_by_the_others_alone() -> None:
    told = history(0.02)
    found = hold_out_runs(told, fit)
    errors, predicted = [], []
    for run in dict.fromkeys(RUNS):
        rows = [row for row, name in enumerate(RUNS) if name != run]
        others = fit(History(COUNTS[rows], told.accuracy[rows], told.weight[rows])).curve
        for row in sorted(set(range(len(RUNS))) - set(rows)):
            predicted.append(1 - float(others.error(*COUNTS[row])))
            errors.append(abs(predicted[-1] - told.accuracy[row]))
    ranks: Any = spearmanr(predicted, told.accuracy)
    assert (found.runs, found.points) == (4, 16)
    assert found.mean_error == pytest.approx(np.mean(errors))
    assert found.rank_correlation == pytest.approx(ranks.statistic)
    assert found.mean_error > np.abs(1 - fit(told).curve.error(*COUNTS.T) - told.accuracy).mean()


def test_an_exact_curve_predicts_exactly() -> None:
    found = hold_out_runs(history(0.0), fit)
    assert found.mean_error < 2e-3
    assert found.rank_correlation == pytest.approx(1.0)
    assert found.attainable == pytest.approx(1.0, abs=1e-2)


def test_two_runs_are_too_few() -> None:
    with pytest.raises(InputError, match="3 or more are wanted in the column 'run', not 2"):
        hold_out_runs(history(0.0).select(COUNTS[:, 0] < 100), fit)


@pytest.mark.slow
def test_the_command_tells_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = history(0.02)
    rows = [f"t,{s:g},{e:g},{c:g},{a:.6f},{r}" for (s, e, c), a, r in zip(COUNTS, told.accuracy, RUNS, strict=True)]
    table = tmp_path / "own.csv"
    table.write_text("task,samples,edge_rounds,cloud_rounds,accuracy,run\n" + "\n".join(rows) + "\n")
    with pytest.raises(SystemExit, match="0"):
        command(["fit", str(table), "--held-out", "--json"])
    (answer,) = json.loads(capsys.readouterr().out)["curves"]
    assert answer["held_out"]["runs"] == 4
    assert answer["held_out"]["mean_error"] == pytest.approx(hold_out_runs(told, fit).mean_error, abs=1e-5)
    with pytest.raises(SystemExit, match="0"):
        command(["fit", str(table), "--held-out"])
    assert "4 runs held out, 16 points" in " ".join(capsys.readouterr().out.split())


SEEDS = np.repeat(["1", "2", "3"], len(COUNTS))
FACTORS = np.array([1.3, 1.0, 0.8])


def several_seeds(noise: float) -> History:
    """Return runs of three seeds, whose errors are those of `history` times 1.3, 1 and 0.8."""
    error = np.tile(1 - history(0).accuracy, 3) * np.repeat(FACTORS, len(COUNTS))
    drawn = np.random.default_rng(3).normal(scale=noise, size=len(error))
    runs = tuple(f"{seed}-{run}" for seed, run in zip(SEEDS, RUNS * 3, strict=True))
    weight = np.random.default_rng(4).uniform(0.5, 2, len(error))
    return History(np.tile(COUNTS, (3, 1)), 1 - error + drawn, weight, runs, tuple(SEEDS))


def test_levels_of_seeds_are_the_effects_of_a_two_way_analysis_of_variance() -> None:
    told = several_seeds(0.01).select(np.arange(3 * len(COUNTS)) != 5)  # unbalanced
    points = [f"{s} {e}" for s, e, _ in told.resources]
    dummies = np.column_stack(
        [np.array(points) == point for point in dict.fromkeys(points)]
        + [np.array(told.seeds) == seed for seed in ("2", "3")]
    ).astype(float)
    root = np.sqrt(told.weight)
    effects = np.linalg.lstsq(dummies * root[:, None], np.log(1 - told.accuracy) * root, rcond=None)[0][-2:]
    found = level_seeds(told)
    assert np.log(found.of("2") / found.of("1")) == pytest.approx(effects[0])
    assert np.log(found.of("3") / found.of("1")) == pytest.approx(effects[1])
    level = sum(weight * np.log(found.of(seed)) for weight, seed in zip(told.weight, told.seeds, strict=True))
    assert level == pytest.approx(0, abs=1e-9)
    assert found.of("unknown") == 1


def test_a_curve_is_that_of_a_mean_seed() -> None:
    told = several_seeds(0.0)
    found = level_seeds(told)
    mean = np.exp(np.average(np.log(np.repeat(FACTORS, len(COUNTS))), weights=told.weight))
    assert [found.of(seed) for seed in "123"] == pytest.approx((FACTORS / mean).tolist())
    assert fit(told).curve.error(*COUNTS.T) == pytest.approx(mean * (1 - history(0).accuracy), abs=2e-3)
    alone = history(0.0)
    assert level_seeds(alone) == Levelled(alone, {})


@pytest.mark.slow
def test_seeds_held_out_are_predicted_without_their_level_and_then_from_pretraining() -> None:
    told = several_seeds(0.0)
    found = hold_out_runs(told, fit)
    assert found.mean_error < 3e-3, "other runs of the seed tell its level"
    new = found.new_seeds
    assert new is not None
    errors = []
    for seed, factor in zip("123", FACTORS, strict=True):
        rest = [other for other in FACTORS if other != factor]
        weights = [told.weight[other == SEEDS].sum() for other in "123" if other != seed]
        level = np.exp(np.average(np.log(rest), weights=weights))
        later = COUNTS[:, 1] > 0
        errors.append(np.abs((level - factor) * (1 - history(0).accuracy[later])).mean())
    assert (new.points, new.mean_error) == (36, pytest.approx(np.mean(errors), rel=0.05))
    assert new.mean_error_pretrained < 3e-3
    assert new.rank_correlation_pretrained > max(0.99, new.rank_correlation)


def test_noise_of_runs_and_what_it_leaves_attainable() -> None:
    runs = np.repeat([f"r{number}" for number in range(200)], 12)
    draw = np.random.default_rng(2)
    residual = np.repeat(draw.normal(0, 0.03, 200), 12) + draw.normal(0, 0.01, 2400)
    assert noise_of_runs(residual, runs) == pytest.approx((0.03, 0.01), rel=0.1)
    assert noise_of_runs(np.tile([0.01, -0.01], 1200), runs)[0] == 0
    assert noise_of_runs(np.array([0.1, -0.1, 0.0]), np.array(["a", "b", "c"])) == pytest.approx(
        (0.1, 0)
    )  # a point each
    expected = draw.normal(0, 0.04, 2400)  # independent normals correlate by r, their ranks by 6/pi asin(r/2)
    normal = 0.04 / np.sqrt(0.04**2 + 0.03**2 + 0.01**2)
    assert attainable_correlation(expected, runs, 0.03, 0.01) == pytest.approx(
        6 / np.pi * np.arcsin(normal / 2), abs=0.02
    )
    assert attainable_correlation(expected, runs, 0, 0) == pytest.approx(1)


def test_the_pure_error_is_what_the_true_curve_leaves_whatever_its_form() -> None:
    """Points of seeds of one level that follow no curve; exact ones leave nothing, those of one seed do not tell."""
    draw = np.random.default_rng(5)
    points = np.array([(s, e, z) for s in range(40, 80) for e in range(5) for z in range(2)], dtype=float)
    truth = draw.uniform(0.3, 0.7, len(points))
    names = [f"n{samples:g}" for samples in points[:, 0]]
    for seeds in ("12", "1234"):
        noise = draw.normal(0, 0.02, (len(seeds), len(points)))
        runs = tuple(f"{seed}-{name}" for seed in seeds for name in names)
        of = tuple(seed for seed in seeds for _ in names)
        told = History(np.tile(points, (len(seeds), 1)), (truth + noise).ravel(), np.ones(len(of)), runs, of)
        assert measure_pure_error(told) == pytest.approx(np.abs(noise).mean(), rel=0.05)
    assert measure_pure_error(several_seeds(0.0)) == pytest.approx(0, abs=1e-9)
    assert measure_pure_error(history(0.02)) is None
    assert measure_pure_error(told.select(np.array(told.runs) == told.runs[0])) is None
