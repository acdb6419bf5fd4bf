"""`flcav place`: roadside sensors that cover most of the registered errors (VRCSP)."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import Method, check_finite, check_png
from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from flcav.config import Json
    from flcav.optimization.placement.solve import Candidates, Placement
    from flcav.optimization.verification.record import Verification
    from flcav.planner.inputs import Given
    from flcav.world.map.town import Town
    from flcav.world.trace import Trace

MAP_IN = 6.4  # width of the map [inch]
LISTED = 20  # number of candidates above which only the chosen ones are listed


@answer_json
def place(
    errors: Path = typer.Option(
        ...,
        help="CSV or Parquet of errors, or points of your own: x, y [m], maybe z, or latitude, longitude; optionally "
        "weight, severity, exposure, class, kind.",
    ),
    poles: Path | None = typer.Option(
        None,
        help="CSV or Parquet of candidate poles: id, x, y [m], maybe z, or latitude, longitude; optionally cost. By "
        "default the town's, and sites along its streets that have none.",
    ),
    every: float | None = typer.Option(
        None, "--every", help="Candidates every so many metres along the town's streets.", callback=check_finite
    ),
    sensors: Path | None = typer.Option(None, help="CSV or Parquet of sensors: name, range_m, cost; one a pole."),
    range_m: float | None = typer.Option(None, "--range", help="How far a sensor covers errors [m]."),
    count: int | None = typer.Option(None, help="How many sensors to place."),
    curve: bool = typer.Option(False, "--curve", help="With --count: what each further sensor gains, from the first."),
    budget: float | None = typer.Option(None, help="What sensors and poles may cost together.", callback=check_finite),
    cover: float | None = typer.Option(
        None, help="Share of the errors' weight, 0 to 1: the cheapest sensors for it.", callback=check_finite
    ),
    method: Method = typer.Option(Method.exact, help="exact proves how much could be covered; greedy is faster."),
    data: Path | None = typer.Option(None, "--data", help="Dataset folder: its traffic, and its town."),
    town: str | None = typer.Option(None, "--town", help="A town's name, or its folder; by default the dataset's."),
    line_of_sight: bool = typer.Option(
        False,
        "--line-of-sight",
        help="Cover only what a pole sees past the town's buildings, and the dataset's traffic.",
    ),
    class_weight: list[str] = typer.Option(
        [],
        "--class-weight",
        metavar="CLASS=FACTOR",
        help="Factor on the weight of a class; may be given several times.",
    ),
    map_: Path | None = typer.Option(
        None, "--map", callback=check_png, help="PNG file of errors, poles and what they cover, in the town."
    ),
    driving: bool = typer.Option(
        False, "--driving", help="Count who is hidden from the dataset's vehicles, from every chosen pole, from both."
    ),
    verify: bool = typer.Option(
        False, "--verify", help="Recompute coverage, cost and bound with no code of the solver; exit 1 if one is wrong."
    ),
) -> Answer:
    """Choose the poles whose sensors cover most of the errors.

    An error is covered where a chosen sensor is within its range, in three dimensions.
    """
    import numpy as np

    from flcav.config import InputError
    from flcav.optimization.placement import solve
    from flcav.optimization.placement.baselines import place_at_random
    from flcav.optimization.placement.cheapest import cover_share
    from flcav.optimization.placement.place import find_seen
    from flcav.planner import inputs as place_inputs
    from flcav.storage.files import check_writable
    from flcav.world.sites import locate_sites

    if poles is not None and every is not None:
        raise InputError("--poles and --every: one of the two says where sensors may stand")
    if curve and count is None:
        raise InputError("--curve: needs --count, up to which it goes")
    for file in (errors, poles, sensors):
        if file is not None and not file.exists():
            raise InputError(f"{file}: no such file")
    if (sensors is None) == (range_m is None):
        raise InputError("--sensors and --range: one of the two says how far sensors cover errors")
    if sum(limit is not None for limit in (count, budget, cover)) != 1:
        raise InputError("--count, --budget and --cover: one of the three says how much to place")
    if map_ is not None:
        check_writable(map_.parent)
    here, traces = place_inputs.read_world(data, town)
    for option, wanted in (("--map", map_ is not None), ("--line-of-sight", line_of_sight), ("--driving", driving)):
        if wanted and here is None:
            raise InputError(f"{option}: needs --town, or --data whose town is known")
    if driving and not traces:
        raise InputError("--driving: needs --data with recorded traffic")
    given = place_inputs.read_given(errors, poles, sensors, range_m, class_weight, town=here, every_m=every)
    if budget is not None and not given.priced:
        table = poles or "a table of --poles"
        raise InputError(f"--budget: nothing has a cost; give {table} a column 'cost', or give --sensors")
    seen = None
    if line_of_sight and here is not None:
        seen = find_seen(given.errors, given.poles, float(given.ranges_m.max()), here, traces)
    candidates = place_inputs.build_candidates(given, seen)
    if count is not None or not given.priced:
        candidates = candidates.at_unit_cost()
    least: float | None = None
    steps: list[solve.Placement] = []
    if count is not None:
        fewer = range(1, count) if curve else ()
        steps = [solve.place_count(candidates, number, method=method.value) for number in fewer]
        result = solve.place_count(candidates, count, method=method.value)
    elif budget is not None:
        result = solve.place_budget(candidates, budget, method=method.value)
    else:
        result, least = cover_share(candidates, cover or 0.0, method=method.value)
    limit = budget if budget is not None else float(count or result.cost)
    conventional = _place_conventionally(candidates, given, limit, here, traces)
    beyond = np.asarray(candidates.covers.sum(axis=0)).ravel() == 0
    if map_ is not None and here is not None:
        _draw(map_, here, given, result, conventional, seen, traces, beyond)
    hidden = None
    if driving and here is not None:
        from flcav.driving.studies.pole_gain import count_hidden

        sites, ranges_m = given.poles[list(result.chosen)], given.ranges_m[list(result.sensors)].tolist()
        hidden = count_hidden(here, traces, sites, ranges_m)
    cost = given.cost_of(result)
    verified = _verify(given, seen, result, least, count, budget, cover) if verify else None
    random = place_at_random(candidates, limit)
    yield {
        "chosen": _name(given, result),
        "covered": result.covered,
        "covered_weight": result.covered_weight,
        "upper_bound": result.upper_bound,
        "optimal": result.optimal,
        "cost": cost,
        "cost_lower_bound": least,
        "marginal_gain": result.marginal_gain,
        "certificate": None if result.certificate is None else asdict(result.certificate),
        **({"curve": _curve_as_json(given, [*steps, result])} if curve else {}),
        **(
            {}
            if here is None
            else {"sites": [asdict(site) for site in locate_sites(here, given.poles[list(result.chosen)])]}
        ),
        **({"notes": [*given.notes]} if given.notes else {}),
        **({} if hidden is None else {"hidden": hidden.as_json()}),
        **({} if verified is None else {"verification": asdict(verified)}),
        "baselines": {
            **{name: None if placed is None else _describe(given, placed) for name, placed in conventional.items()},
            "random": {"covered": random.covered, "covered_weight": random.covered_weight},
        },
    }
    yield from given.notes
    yield from _list_lines(given, np.diff(candidates.covers.indptr).tolist(), result, conventional, least, here)
    if beyond.any():
        yield f"beyond every pole: {beyond.sum()} of {given.count()}"
    if curve:
        yield from _list_curve(given, [*steps, result])
    if hidden is not None:
        yield from hidden.lines()
    if verified is not None:
        yield from verified.lines(counted=count is not None or not given.priced)
    if verified is not None and verified.faults:
        raise typer.Exit(1)


def _list_lines(
    given: "Given",
    near: list[int],
    result: "Placement",
    conventional: "dict[str, Placement | None]",
    least: float | None,
    town: "Town | None",
) -> Iterator[str]:
    """Yield the placement in words; `near` has the number of errors within range of each candidate."""
    from flcav.world.sites import locate_sites

    cost, by_range = given.cost_of(result), given.names == (None,)
    chosen = [f"{pair['pole']}" + ("" if by_range else f" ({pair['sensor']})") for pair in _name(given, result)]
    yield (f"poles {', '.join(chosen)}")
    places = [] if town is None else [f" at {site}" for site in locate_sites(town, given.poles[list(result.chosen)])]
    at = dict(zip(result.chosen, places))
    listed = range(len(given.ids)) if len(given.ids) <= LISTED else result.chosen
    for number in listed if by_range else ():
        placed = f", placed{at.get(number, '')}" if number in result.chosen else ""
        yield f"    pole {given.ids[number]}: {plural(near[number], given.noun)} within {given.ranges_m[0]:g} m{placed}"
    if by_range and len(listed) < len(near):
        most = max((errors for number, errors in enumerate(near) if number not in result.chosen), default=0)
        yield f"    {plural(len(near) - len(listed), 'other candidate')}: at most {plural(most, given.noun)}"
    yield from () if by_range else (f"    pole {pole}{place}" for pole, place in zip(chosen, places))
    proof = "optimal" if result.optimal else f"at most {result.upper_bound:.10g} can be covered"
    if least is not None and not result.optimal:
        proof = f"at least {least:.10g} has to be spent for that"
    priced = "" if cost is None else f", cost {cost:.10g}"
    yield (f"cover {given.count(result.covered)}, weight {result.covered_weight:.10g}{priced} ({proof})")
    for name, placed in conventional.items():
        if placed is not None:
            yield (f"by {name.replace('-', ' ')}: weight {placed.covered_weight:.10g}")


def _list_curve(given: "Given", steps: "list[Placement]") -> Iterator[str]:
    """Yield the gain of each further sensor in words; `steps` are the placements of 1, 2, ... sensors."""
    yield "gain of each further sensor, all of them placed anew:"
    before = 0.0
    for number, placed in enumerate(steps, start=1):
        gain, before = placed.covered_weight - before, placed.covered_weight
        share = 100 * placed.covered_weight / float(given.weight.sum())
        poles = ", ".join(str(given.ids[pole]) for pole in placed.chosen)
        proof = "" if placed.optimal else f", at most {placed.upper_bound:.10g} can be covered"
        covered = f"weight {placed.covered_weight:.10g} ({share:.1f} %), gain {gain:.10g}{proof}"
        yield f"    {plural(number, 'sensor')}: {covered}; on {poles}"


def _curve_as_json(given: "Given", steps: "list[Placement]") -> "Json":
    before, values = 0.0, []
    for placed in steps:
        gain, before = placed.covered_weight - before, placed.covered_weight
        proof = {"gain": gain, "upper_bound": placed.upper_bound, "optimal": placed.optimal}
        values.append({**_describe(given, placed), **proof})
    return values


def _verify(
    given: "Given",
    seen: "csr_array | None",
    result: "Placement",
    least: float | None,
    count: int | None,
    budget: float | None,
    cover: float | None,
) -> "Verification":
    import numpy as np

    from flcav.optimization.verification.placement import PlacementProblem, verify_placement

    cost = given.costs
    if count is not None or not given.priced:
        cost = np.ones(cost.shape)
    visible = None if seen is None else seen.toarray() > 0
    places = (given.errors, given.weight, given.poles, given.ranges_m)
    return verify_placement(
        PlacementProblem(*places, cost, count, budget, cover, visible), json.dumps(asdict(result)), least
    )


def _place_conventionally(
    candidates: "Candidates", given: "Given", limit: float, town: "Town | None", traces: "list[Trace]"
) -> "dict[str, Placement | None]":
    """Return the placements by visible objects and by traffic density; None without a town or traffic."""
    import numpy as np

    from flcav.optimization.placement.baselines import place_by_score
    from flcav.world.line_of_sight import count_visible_actors
    from flcav.world.map.census import measure_traffic_density

    ranges = given.ranges_m[candidates.order].tolist()
    density = visible = None
    if traces:
        near = [measure_traffic_density(given.poles, traces, range_m) for range_m in ranges]
        density = place_by_score(candidates, np.stack(near, axis=1).ravel(), limit)
        if town is not None:
            seen = count_visible_actors(town, traces, given.poles, ranges)
            visible = place_by_score(candidates, seen.ravel(), limit)
    return {"visible-objects": visible, "traffic-density": density}


def _name(given: "Given", placed: "Placement") -> "list[dict[str, Json]]":
    return [
        {"pole": given.ids[pole], "sensor": given.names[sensor]}
        for pole, sensor in zip(placed.chosen, placed.sensors, strict=True)
    ]


def _describe(given: "Given", placed: "Placement") -> "dict[str, Json]":
    return {"chosen": _name(given, placed), "covered": placed.covered, "covered_weight": placed.covered_weight}


def _draw(
    path: Path,
    town: "Town",
    given: "Given",
    placed: "Placement",
    conventional: "dict[str, Placement | None]",
    seen: "csr_array | None",
    traces: "list[Trace]",
    beyond: "NDArray[np.bool_]",
) -> None:
    """Write the map of errors, poles, the placement, and the placements by conventional rules.

    With line of sight (`seen`), the map shows the viewsheds of the sensors. `beyond` (E,): whether no pole reaches an
    error.
    """
    from flcav.report import style
    from flcav.report.charts.figures import town_map
    from flcav.report.pictures.maps import DENSEST, LONGEST, MOST_VISIBLE, ErrorMap
    from flcav.storage.files import write_bytes
    from flcav.world.line_of_sight import find_viewshed

    names = [str(pole) for pole in given.ids]
    notes = _note(given, placed)
    if max(map(len, names)) > LONGEST:
        names = [str(row) for row in range(1, len(names) + 1)]
        notes.append("in brackets, and on the map: a pole's row in the table")
    ranges = {names[pole]: float(given.ranges_m[sensor]) for pole, sensor in zip(placed.chosen, placed.sensors)}
    sites = dict(zip(names, given.poles, strict=True))
    noted = {
        note: [names[pole] for pole in rule_placed.chosen]
        for note, rule in ((DENSEST, "traffic-density"), (MOST_VISIBLE, "visible-objects"))
        if (rule_placed := conventional[rule]) is not None
    }
    scene = ErrorMap(
        town,
        given.errors,
        given.kind,
        sites,
        ranges,
        given.covered_by(placed, seen),
        {}
        if seen is None
        else {name: find_viewshed(town, traces, sites[name], range_m) for name, range_m in ranges.items()},
        notes,
        noted,
        heat=True,
        title=f"{town.name}: {plural(len(placed.chosen), 'sensor')} for {given.count()}",
        noun=given.noun,
        beyond=beyond,
    )
    write_bytes(path, style.png(town_map(scene, MAP_IN)))


def _note(given: "Given", placed: "Placement") -> list[str]:
    """Return lines on the placement: covered errors and cost, then poles and cost by kind of sensor."""
    from flcav.report.pictures.maps import LONGEST, name_poles

    def name(pole: int) -> str:
        number = str(given.ids[pole])
        return number if max(len(str(other)) for other in given.ids) <= LONGEST else f"{number} ({pole + 1})"

    def cost(chosen: "list[tuple[int, int]]") -> str:
        total = float(sum(given.costs[pair] for pair in chosen))
        return f", cost {total:.6g}" if given.priced else ""

    pairs = list(zip(placed.chosen, placed.sensors, strict=True))
    lines = [f"{given.count(placed.covered)} covered{cost(pairs)}"]
    for kind, (sensor_name, range_m) in enumerate(zip(given.names, given.ranges_m, strict=True)):
        if of_kind := [(pole, sensor) for pole, sensor in pairs if sensor == kind]:
            poles = name_poles([name(pole) for pole, _ in of_kind])
            line = f"{sensor_name or 'sensor'}, range {range_m:g} m, on {poles}"
            lines.append(line + (cost(of_kind) if len(of_kind) < len(pairs) else ""))
    return lines
