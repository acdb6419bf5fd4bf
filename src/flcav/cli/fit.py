"""`flcav fit`: learning curves from a history of training runs."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from flcav.optimization.learning_curve import Fit


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("fit")(fit)


def fit(
    history: Path = typer.Argument(..., help="CSV: task, stage (pretrain, edge, cloud), resource, accuracy[, weight]."),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Fit how the error falls with samples and rounds, one curve per task."""
    import numpy as np

    from flcav.cli.tables import numbers, read_table
    from flcav.config import InputError
    from flcav.optimization.curves import STAGES
    from flcav.optimization.learning_curve import fit_additive, resources_in_order

    table = read_table(history, ("task", "stage", "resource", "accuracy"))
    stages = table["stage"].to_pylist()
    for row, stage in enumerate(stages, start=1):
        if stage not in STAGES:
            raise InputError(f"{history}: row {row}: stage = {stage!r} must be one of {', '.join(STAGES)}")
    values = numbers(table, ("resource", "accuracy"), history)
    weight = np.ones(len(values))
    if "weight" in table.column_names:
        weight = numbers(table, ("weight",), history)[:, 0]
    for name, column, least, most in (
        ("resource", values[:, 0], 0.0, np.inf),
        ("accuracy", values[:, 1], 0.0, 1.0),
        ("weight", weight, 0.0, np.inf),
    ):
        wrong = np.flatnonzero((column < least) | (column > most))
        if len(wrong):
            allowed = "at least 0" if most == np.inf else "from 0 to 1"
            raise InputError(f"{history}: row {wrong[0] + 1}: {name} = {column[wrong[0]]:g} must be {allowed}")
    tasks = table["task"].to_pylist()
    fits: dict[str, Fit] = {}
    for task in dict.fromkeys(tasks):
        rows = [row for row, name in enumerate(tasks) if name == task]
        spent = resources_in_order([stages[row] for row in rows], values[rows, 0])
        try:
            fits[str(task)] = fit_additive(spent[:, 0], spent[:, 1], spent[:, 2], values[rows, 1], weight[rows])
        except InputError as error:
            raise InputError(f"{history}: task {task!r}: {error}") from None
    if as_json:
        typer.echo(json.dumps({"curves": [_as_json(task, each) for task, each in fits.items()]}))
    else:
        _show(fits)


def _as_json(task: str, each: "Fit") -> dict:
    return {"task": task, **each.curve.model_dump(), "rmse": each.rmse, "points": each.points}


def _show(fits: dict[str, "Fit"]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("task", "floor", "pretrain", "edge", "cloud", "rmse", "points")
    for task, each in fits.items():
        cells = [
            f"{decay.a:.4g} (x + {decay.x0:.4g})^-{decay.b:.4g}" if decay.a > 0 else "-"
            for decay in each.curve.decays()
        ]
        table.add_row(task, f"{each.curve.floor:.4g}", *cells, f"{each.rmse:.4f}", str(each.points))
    Console().print(table)
