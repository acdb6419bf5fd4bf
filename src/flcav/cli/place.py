"""`flcav place`: where a roadside sensor covers most of the registered errors (VRCSP)."""

import json
from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("place")(place)


def place(
    errors: Path = typer.Option(..., help="CSV or Parquet of errors: x, y, z [m], optionally weight."),
    poles: Path = typer.Option(..., help="CSV or Parquet of candidate poles: id, x, y, z [m]."),
    range_m: float = typer.Option(..., "--range", help="How far a sensor covers errors [m]."),
    count: int = typer.Option(..., help="How many sensors to place."),
    method: str = typer.Option("exact", help="exact or greedy."),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Choose the poles whose sensors cover most of the errors."""
    from flcav.cli.tables import numbers, read_table
    from flcav.config import InputError
    from flcav.optimization import placement

    if method not in ("exact", "greedy"):
        raise InputError(f"--method = {method!r}: must be exact or greedy")
    axes = ("x", "y", "z")
    mistakes, sites = read_table(errors, axes), read_table(poles, ("id", *axes))
    weight = numbers(mistakes, ("weight",), errors)[:, 0] if "weight" in mistakes.column_names else None
    result = placement.place(
        numbers(mistakes, axes, errors), numbers(sites, axes, poles), range_m, count, weight=weight, method=method
    )
    ids = sites["id"].to_pylist()
    chosen = [ids[pole] for pole in result.chosen]
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "chosen": [{"pole": pole} for pole in chosen],
                    "covered": result.covered,
                    "covered_weight": result.covered_weight,
                    "upper_bound": result.upper_bound,
                    "optimal": result.optimal,
                }
            )
        )
        return
    proof = "optimal" if result.optimal else f"at most {result.upper_bound:.6g} can be covered"
    typer.echo(f"poles {', '.join(map(str, chosen))}")
    typer.echo(f"cover {result.covered} of {mistakes.num_rows} errors, weight {result.covered_weight:.6g} ({proof})")
