"""`flcav fit`: learning curves from a history of training runs."""

import dataclasses
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flcav.cli.options import check_all_finite, check_finite, refuse_unused
from flcav.cli.terminal import Answer, answer_json, only_writer_of
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flcav.optimization.allocation.problem_file import FittedFields
    from flcav.optimization.curves.bands import Bands
    from flcav.optimization.curves.curves import OwnCurve
    from flcav.optimization.curves.fitting import CurveFit
    from flcav.optimization.curves.history import History


class CurveForm(StrEnum):
    """Form of the learning curve: how the stages add up."""

    additive = "additive"
    effective = "effective"
    federated = "federated"
    best = "best"


ROUNDS = {  # letters in the formula of each model
    "additive": "y edge, z cloud rounds",
    "effective": "t rounds",
    "federated": "t rounds, z cloud rounds",
}


@only_writer_of("problem")
@answer_json
def fit(
    history: Path = typer.Argument(
        ..., help="CSV: task, stage (pretrain, edge, cloud), resource, accuracy[, weight]; or [task,] samples, "
        "edge_rounds, cloud_rounds, accuracy[, weight][, run][, seed], of whose numbers one is enough, in columns as "
        "people name them. error = 1 - accuracy may stand for accuracy."
    ),
    problem: Path | None = typer.Option(
        None, "--problem", help="YAML: put the curves into this problem for `flcav allocate`; where there is no such "
        "file, write one with the rest to fill in."
    ),
    model: CurveForm = typer.Option(CurveForm.additive, "--model", help="How the stages add up; best: additive or "
        "federated, whichever has the smaller AICc, as runs are planned."),
    at: list[str] = typer.Option(
        [], "--at", metavar="SAMPLES[,EDGE_ROUNDS[,CLOUD_ROUNDS]]", help="Where to predict the error; may be given "
        "several times."
    ),
    group_samples: list[float] = typer.Option(
        [], "--group-samples", min=0, max=1e9, callback=check_all_finite, help="effective, federated: samples that "
        "the vehicles of a region hold; given once per region."
    ),
    alpha: float = typer.Option(
        0.1, "--alpha", min=1e-9, max=1e9, callback=check_finite, help="effective, federated: worth of a pretraining "
        "sample."
    ),
    beta: float | None = typer.Option(
        None, "--beta", min=0, max=1e9, callback=check_finite, help="effective, federated: worth of a held sample; "
        "else fitted."
    ),
    k: int = typer.Option(
        1, "--edge-rounds-per-cloud-round", "-k", min=0, max=10**9, help="effective, federated: edge rounds in a cloud "
        "round."
    ),
    level: float = typer.Option(
        0.9, "--level", min=0.01, max=0.999, callback=check_finite, help="Share of repeats between the bands."
    ),
    repeats: int = typer.Option(200, "--repeats", min=20, max=10**5, help="Bootstrap repeats of the bands."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of the bootstrap."),
    held_out: bool = typer.Option(
        False, "--held-out", help="Also predict each run (column run) by the curve of all other runs, and each seed "
        "by that of the others."
    ),
) -> Answer:  # fmt: skip
    """Fit how the error falls with samples and rounds, one curve per task, with bootstrap bands."""
    from flcav.config import InputError
    from flcav.optimization.allocation.problem_file import collect_fitted_fields
    from flcav.optimization.curves import fitting
    from flcav.optimization.curves.bands import bootstrap_bands, fit_lower_curve, fit_upper_curve
    from flcav.optimization.curves.held_out import hold_out_runs
    from flcav.optimization.curves.history import parse_histories
    from flcav.storage.tables import read_input_table

    if model is CurveForm.additive:
        refuse_unused("--model additive", "group_samples", "alpha", "beta", "k")

    points_at = [_counts(text) for text in at]
    held, unnamed = _held(problem, history.stem)
    answers, fits, found_of = [], [], {}

    def fit_curve(points: "History") -> "CurveFit":
        return fitting.fit(points, model=model.value, group_samples=group_samples, k=k, alpha=alpha, beta=beta)

    for task, points in parse_histories(read_input_table(history, ()).to_pydict(), str(history), unnamed).items():
        try:
            fitted = fit_curve(points)
            checked = hold_out_runs(points, fit_curve, k) if held_out else None
        except InputError as error:
            raise InputError(f"{history}: task {task!r}: {error}") from None
        band = bootstrap_bands(fitted, level=level, repeats=repeats, seed=seed, k=k)
        upper = None if band is None else fit_upper_curve(fitted, band)
        answer = _answer(task, fitted, band, upper, points, points_at, k)
        answers.append(answer if checked is None else answer | {"held_out": dataclasses.asdict(checked)})
        fits.append(fitted)
        lower = None if band is None else fit_lower_curve(fitted, band)
        found_of[task] = collect_fitted_fields(fitted, points.resources, upper, lower)
    if problem is not None:
        _write(problem, held, found_of, k, history.name)
    yield {"curves": answers}
    yield from _list_lines(answers, fits)
    if problem is not None:
        yield _next(problem, list(found_of))


def _held(problem: Path | None, stem: str) -> tuple[str | None, str]:
    """Return the text of the problem file, if it exists, and the task of a history that does not name one.

    The task is the only one of the problem, or otherwise the name `stem` of the history's file.
    """
    from flcav.config import InputError, read_yaml
    from flcav.optimization.allocation.problem_file import read_task_names

    if problem is None or not (problem.exists() or problem.is_symlink()):
        return None, stem
    if problem.suffix == ".json":
        raise InputError(f"{problem}: --problem writes YAML")
    read_yaml(problem)  # raises for a file that is no YAML
    text = problem.read_bytes().decode("utf-8")
    names = read_task_names(text, str(problem))
    return text, names[0] if len(names) == 1 else stem


def _write(problem: Path, held: str | None, found: "Mapping[str, FittedFields]", k: int, history: str) -> None:
    from flcav.optimization.allocation.problem_file import format_problem, insert_curves
    from flcav.storage.files import write_bytes

    text = format_problem(found, k, history) if held is None else insert_curves(held, found, k, str(problem))
    write_bytes(problem, text.encode())


def _next(problem: Path, tasks: list[str]) -> str:
    """Return the message about the written problem, and whether `flcav allocate` accepts it."""
    from flcav.config import InputError
    from flcav.optimization.graph import load_problem

    message = f"{problem}: now has the curve{'s' if len(tasks) > 1 else ''} of {', '.join(tasks)}"
    try:
        load_problem(problem)
    except InputError as error:
        return f"{message}; not yet what `flcav allocate` takes: {str(error).removeprefix(f'{problem}: ')}"
    return f"{message}; next: flcav allocate {problem}"


def _counts(text: str) -> list[float]:
    from flcav.config import InputError

    try:
        counts = [float(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if not 1 <= len(counts) <= 3 or not all(0 <= count <= 1e9 for count in counts):
        raise InputError(f"--at {text!r} must be SAMPLES[,EDGE_ROUNDS[,CLOUD_ROUNDS]], each from 0 to 1e+09")
    return counts + [0.0] * (3 - len(counts))


def _answer(
    task: str,
    fit: "CurveFit",
    found: "Bands | None",
    upper: "OwnCurve | None",
    points: "History",
    asked: list[list[float]],
    k: int,
) -> dict[str, Any]:
    """Return a curve with its bands and the predictions at the counts `asked` as a JSON object."""
    import numpy as np

    from flcav.optimization.curves.bands import METHOD, tabulate_bands

    band = None
    if found is not None:
        band = {
            **{"method": METHOD, "level": found.level, "repeats": len(found.curves), "seed": found.seed},
            "at": tabulate_bands(fit, found, np.unique(points.resources, axis=0), k),
        }
    predicted = tabulate_bands(fit, found, np.array(asked).reshape(-1, 3), k)
    extrapolated = [fit.explain_extrapolation(*counts) for counts in asked]
    return {
        "task": task,
        **fit.curve.model_dump(),
        **{"rmse": fit.rmse, "points": fit.points, "r_squared": fit.r_squared, "aicc": fit.aicc},
        "measured": fit.measured,
        "band": band,
        "upper": None if upper is None else upper.model_dump(),
        "asked": [{**row, "warning": warning} for row, warning in zip(predicted, extrapolated)],
        "warnings": [*points.warnings, *fit.warnings, *filter(None, extrapolated)],
    }


def _list_lines(answers: list[dict[str, Any]], fits: list["CurveFit"]) -> Iterator[Any]:
    from rich.table import Table
    from rich.text import Text

    rounds = dict.fromkeys(ROUNDS[fit.curve.model] for fit in fits)
    table = Table("task", f"error after x samples, {' or '.join(rounds)}", "rmse", "R²", "points")
    for answer, fit in zip(answers, fits):
        explained = "–" if fit.r_squared is None else f"{fit.r_squared:.3f}"
        table.add_row(answer["task"], str(fit.curve), f"{fit.rmse:.4f}", explained, str(fit.points))
    yield table
    for answer in answers:
        for row in answer["asked"]:
            between = (
                ""
                if row["low"] is None
                else f", {answer['band']['level']:.0%} band {row['low']:.4f} to {row['high']:.4f}"
            )
            counts = f"{row['samples']:g} samples, {row['edge_rounds']:g} edge, {row['cloud_rounds']:g} cloud rounds"
            yield Text(f"{answer['task']}: error {row['error']:.4f} at {counts}{between}")
        if "held_out" in answer:
            checked = answer["held_out"]
            lines = (
                f"{plural(checked['runs'], 'run')} held out, {plural(checked['points'], 'point')}: "
                f"mean error of the prediction "
                f"{checked['mean_error']:.4f}, rank correlation {checked['rank_correlation']:.3f}",
                f"runs differ by {checked['between_runs']:.4f}, their points by {checked['within_runs']:.4f} (standard"
                f" deviations): the true curve would reach a rank correlation of {checked['attainable']:.3f}",
            )
            if (least := checked["attainable_error"]) is not None:
                lines += (
                    "seeds differ by so much at the same samples and rounds that the true curve would be off by "
                    f"{least:.4f}",
                )
            if new := checked["new_seeds"]:
                lines += (
                    f"seeds held out whole, {plural(new['points'], 'point')} after pretraining: mean error "
                    f"{new['mean_error']:.4f}, rank correlation {new['rank_correlation']:.3f} before the run; scaled to"
                    f" what its run reached by pretraining {new['mean_error_pretrained']:.4f} and "
                    f"{new['rank_correlation_pretrained']:.3f}",
                )
            for line in lines:
                yield Text(f"{answer['task']}: {line}")
        for warning in answer["warnings"]:
            yield Text(f"{answer['task']}: {warning}")
