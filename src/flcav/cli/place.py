"""`flcav place`: where a roadside sensor covers most of the registered errors (VRCSP)."""

import json
from pathlib import Path

import typer

from flcav.cli.choices import Method


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("place")(place)


def place(
    errors: Path = typer.Option(..., help="CSV or Parquet of errors: x, y, z [m], optionally weight."),
    poles: Path = typer.Option(..., help="CSV or Parquet of candidate poles: id, x, y, z [m]."),
    range_m: float = typer.Option(..., "--range", help="How far a sensor covers errors [m]."),
    count: int = typer.Option(..., help="How many sensors to place."),
    method: Method = typer.Option(Method.exact, help="exact proves that no poles cover more; greedy is faster."),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Choose the poles whose sensors cover most of the errors."""
    from flcav.cli.tables import numbers, read_table
    from flcav.optimization import placement

    axes = ("x", "y", "z")
    mistakes, sites = read_table(errors, axes), read_table(poles, ("id", *axes))
    weight = numbers(mistakes, ("weight",), errors)[:, 0] if "weight" in mistakes.column_names else None
    result = placement.place(
        numbers(mistakes, axes, errors), numbers(sites, axes, poles), range_m, count, weight=weight, method=method.value
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
