"""`flcav planner`: placements, plans and runs in a browser."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_finite, refuse_unused
from flcav.cli.terminal import echo

if TYPE_CHECKING:
    from flcav.planner.desk import Desk

RESULTS = "results.json"  # file of a finished run


def planner(
    what: str | None = typer.Argument(
        None,
        help="A town's name or folder, an OpenDRIVE map (.xodr), the folder of a finished run, or a problem of `flcav "
        "allocate` (.yaml); by default the towns of flcav to choose from.",
    ),
    errors: Path | None = typer.Option(None, help="A town's errors, or points of your own, as of `flcav place`."),
    poles: Path | None = typer.Option(None, help="Candidate poles, as of `flcav place`; by default the town's."),
    every: float | None = typer.Option(
        None, "--every", help="Candidates every so many metres along the town's streets.", callback=check_finite
    ),
    sensors: Path | None = typer.Option(None, help="CSV or Parquet of sensors: name, range_m, cost; one a pole."),
    range_m: float | None = typer.Option(
        None,
        "--range",
        min=1,
        max=2000,
        callback=check_finite,
        help="How far a sensor covers errors [m]; by default 40.",
    ),
    data: Path | None = typer.Option(None, "--data", help="Dataset folder, whose traffic is in the way, too."),
    port: int | None = typer.Option(None, "--port", min=1, max=65535, help="Port; by default any that is free."),
    html: Path | None = typer.Option(
        None, "--html", help="Write one page (HTML) that works without flcav, in place of serving it."
    ),
) -> None:
    """Plan in the browser, on this machine alone: where sensors see most errors, and what to send."""
    if html is not None:
        refuse_unused("--html", "port")
    desk = _lay(what, errors, poles, every, sensors, range_m, data)
    if html is not None:
        from flcav.planner.saving import save_page
        from flcav.storage.files import write_bytes

        write_bytes(html, save_page(desk))
        echo(f"{html}: {html.stat().st_size / 1e6:.1f} MB, a page that needs no server")
        return
    from flcav.planner.server import serve_planner

    serve_planner(
        desk,
        port,
        lambda address: echo(f"{address}\n    open it in a browser on this machine; Ctrl-C ends the planner"),
    )


def _lay(
    what: str | None,
    errors: Path | None,
    poles: Path | None,
    every: float | None,
    sensors: Path | None,
    range_m: float | None,
    data: Path | None,
) -> "Desk":
    """Return the desk with what the arguments name; raises `InputError` where they do not go together."""
    from dataclasses import replace

    from flcav.config import InputError
    from flcav.optimization.graph import load_problem
    from flcav.planner.desk import ONE_KIND, RANGE_M, Desk, lay_out, lay_out_map
    from flcav.planner.inputs import read_given, read_kinds, read_sites, read_world
    from flcav.planner.placing import Kinds
    from flcav.sources.recipe import find_recipe

    if poles is not None and every is not None:
        raise InputError("--poles and --every: one of the two says where sensors may stand")
    if sensors is not None and range_m is not None:
        raise InputError("--sensors and --range: one of the two says how far sensors cover errors")
    for file in (errors, poles, sensors):
        if file is not None and not file.exists():
            raise InputError(f"{file}: no such file")
    ending, finished = Path(what or "").suffix.lower(), what is not None and (Path(what) / RESULTS).exists()
    placing = {"--errors": errors, "--poles": poles, "--every": every, "--data": data}
    if ending in (".yaml", ".yml", ".json") or finished:
        placing |= {"--sensors": sensors, "--range": range_m}
    elif ending == ".xodr":
        placing = {"--data": data}
    elif what is not None or data is not None:
        placing = {}
    for option, given in placing.items():
        if given is not None:
            raise InputError(f"{option}: has no use for {what}" if what else f"{option}: needs a town")
    kinds = ONE_KIND if range_m is None else replace(ONE_KIND, ranges_m=(range_m,))
    if sensors is not None:
        names, ranges_m, costs = read_kinds(sensors)
        kinds = Kinds(names, tuple(ranges_m.tolist()), tuple(costs.tolist()))
    desk = Desk(kinds)
    if ending in (".yaml", ".yml", ".json"):
        path = find_recipe(Path(what or ""))
        desk.problem, desk.problem_name = load_problem(path), path.name
        return desk
    if finished:
        from flcav.planner.replaying import open_run  # loads torch, as runs do

        return open_run(Path(what or ""))
    if what is None and data is None:
        return desk
    if ending == ".xodr":
        space = lay_out_map(Path(what or ""))
    else:
        town, traces = read_world(data, what)
        if town is None:
            raise InputError(f"--data {data}: its town is not known; name one")
        space = lay_out(town, tuple(traces))
    if poles is not None or every is not None:
        space = replace(space, sites=read_sites(poles, space.town, every))
    typed = [f"--town {what}" if what else "", f"--data {data}" if data else ""]
    typed += [f"--poles {poles}" if poles else "", f"--every {every:g}" if every else ""]
    if errors is not None:
        given = read_given(errors, poles, None, RANGE_M, (), town=space.town, every_m=every)
        space, typed = replace(space, given=given, name=errors.name), [*typed, f"--errors {errors}"]
    desk.first = desk.add(replace(space, typed=" ".join(filter(None, typed))))
    return desk
