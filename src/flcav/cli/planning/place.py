"""`flcav place`: roadside sensors that cover most of the registered errors (VRCSP)."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import Method
from flcav.cli.terminal import print_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from flcav.world.map.town import Town

FAR = 10  # times the size of a town: what lies beyond is on no map of it


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("place")(place)


def place(
    errors: Path = typer.Option(..., help="CSV or Parquet of errors: x, y, z [m], optionally weight."),
    poles: Path = typer.Option(..., help="CSV or Parquet of candidate poles: id, x, y, z [m]."),
    range_m: float = typer.Option(..., "--range", help="How far a sensor covers errors [m]."),
    count: int = typer.Option(..., help="How many sensors to place."),
    method: Method = typer.Option(Method.exact, help="exact proves that no poles cover more; greedy is faster."),
    town: str | None = typer.Option(None, "--town", help="With --map: a town's name, or its folder."),
    map_: Path | None = typer.Option(None, "--map", help="With --town: PNG file of errors, poles and what they cover."),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Choose the poles whose sensors cover most of the errors.

    An error is covered where a chosen sensor is within its range, in three dimensions.
    """
    import numpy as np

    from flcav.cli.tables import numbers, read_table
    from flcav.config import InputError
    from flcav.files import check_writable, write_bytes
    from flcav.optimization import placement
    from flcav.report import style
    from flcav.report.charts.figures import town_map
    from flcav.report.pictures.maps import ErrorMap
    from flcav.world.map.town import load_town

    if (town is None) != (map_ is None):
        raise InputError("--town and --map: each needs the other; the map is of the town")
    if map_ is not None:
        check_writable(map_.parent)
    here = None if town is None else load_town(town)
    axes = ("x", "y", "z")
    mistakes, sites = read_table(errors, axes), read_table(poles, ("id", *axes))
    weight = numbers(mistakes, ("weight",), errors)[:, 0] if "weight" in mistakes.column_names else None
    where, mounts = numbers(mistakes, axes, errors), numbers(sites, axes, poles)
    if here is not None:
        _check_near(here, where, errors)
        _check_near(here, mounts, poles)
    result = placement.place(where, mounts, range_m, count, weight=weight, method=method.value)
    ids = sites["id"].to_pylist()
    chosen = [ids[pole] for pole in result.chosen]
    if here is not None and map_ is not None:
        kind = mistakes["kind"].to_pylist() if "kind" in mistakes.column_names else ["error"] * mistakes.num_rows
        candidates = {str(pole): at for pole, at in zip(ids, mounts, strict=True)}
        placed = [str(pole) for pole in chosen]
        scene = ErrorMap(here, where, np.array(kind, dtype=np.str_), candidates, placed, range_m=range_m)
        write_bytes(map_, style.png(town_map(scene)))
    if as_json:
        print_json(
            {
                "chosen": [{"pole": pole} for pole in chosen],
                "covered": result.covered,
                "covered_weight": result.covered_weight,
                "upper_bound": result.upper_bound,
                "optimal": result.optimal,
            }
        )
        return
    proof = "optimal" if result.optimal else f"at most {result.upper_bound:.6g} can be covered"
    typer.echo(f"poles {', '.join(map(str, chosen))}")
    for pole, near in zip(ids, placement.coverage(where, mounts, range_m).sum(axis=1).tolist(), strict=True):
        typer.echo(f"    pole {pole}: {near} errors within {range_m:g} m{', placed' if pole in chosen else ''}")
    typer.echo(f"cover {result.covered} of {mistakes.num_rows} errors, weight {result.covered_weight:.6g} ({proof})")


def _check_near(town: "Town", places: "NDArray[np.float64]", file: Path) -> None:
    """Raise `InputError` naming the first of `places` (N, 3) [m] of `file` that no map of the town can show."""
    import numpy as np

    from flcav.config import InputError

    low_x, low_y, high_x, high_y = town.bounds
    middle, reach_m = np.array([low_x + high_x, low_y + high_y]) / 2, FAR * max(high_x - low_x, high_y - low_y)
    far = np.flatnonzero((np.abs(places[:, :2] - middle) > reach_m).any(axis=1))
    if len(far):
        x, y = places[far[0], :2]
        raise InputError(f"{file}: row {far[0] + 1} lies at {x:g}, {y:g}, far from {town.name}")
