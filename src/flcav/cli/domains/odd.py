"""`flcav odd`: operational design domains, their coverage by recordings, and tasks for the scenarios of recordings."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.domains.sampling import ODD
from flcav.cli.options import Device, check_finite
from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads
from flcav.storage.tables import numbers, read_input_table

if TYPE_CHECKING:
    from flcav.odd.cells import CellErrors
    from flcav.statistics.estimates import Estimate


odd = typer.Typer(
    help="Operational design domains in ASAM OpenODD: check them, judge recordings by them, sample recipes in them.",
    no_args_is_help=True,
)


@odd.command()
@answer_json
def check(
    domain: str = ODD,
    town: str | None = typer.Option(
        None, "--town", help="Town, by name or folder, whose places are checked; default: flcav's four."
    ),
    data: Path | None = typer.Option(None, "--data", help="Dataset folder: what its frames realise."),
) -> Answer:
    """Check which parts of a domain are realised, and which are unknown.

    Each attribute that the domain tests is taken alone, the others left open. What nothing measures is unknown, never
    inside.
    """
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.odd.domain import read_domain
    from flcav.odd.judge import check_frames, check_towns
    from flcav.odd.measure import measure_domain
    from flcav.odd.scenery import Scenery
    from flcav.world.map.town import TOWNS, load_town

    if town is not None and data is not None:
        raise InputError("--town and --data: one of the two at most")
    found = read_domain(domain)
    if data is not None:
        parts = check_frames(found, measure_domain(Dataset.open(data)))
    else:
        parts = check_towns(found, [Scenery(load_town(name)) for name in (TOWNS if town is None else (town,))])
    rows = [part.as_json() | {"realised": part.realised} for part in parts]
    yield {"domain": found.name, "revision": found.definition.revision, "parts": rows}
    where = f"frames of {data}" if data else f"places of {town or ', '.join(TOWNS)}"
    yield f"{found.name}: {plural(len(parts), 'attribute')} tested, against {where}"
    for part in parts:
        yield f"    {part.attribute:<32}{part.sentence}"


@odd.command("of")
@answer_json
def of_(
    data: Path = typer.Argument(help="Dataset folder."),
    out: Path | None = typer.Option(None, "--out", help="Folder for OpenODD's tables: a COD per run."),
) -> Answer:
    """Describe the domain that a recording covers, by its ground truth: the current operational domain (COD)."""
    from flcav.dataset.store import Dataset
    from flcav.odd.coverage import collect_runs, write_cod
    from flcav.odd.domain import everything
    from flcav.odd.measure import measure_domain, summarise_measurements
    from flcav.storage.files import check_writable

    if out is not None:
        check_writable(out)
    recorded = Dataset.open(data)
    measured = measure_domain(recorded)
    spans = summarise_measurements(measured)
    rows = None
    if out is not None:
        rows = write_cod(collect_runs(everything(), recorded, measured), out)
    yield {"frames": len(measured), "rows": rows, "attributes": [span.as_json() for span in spans]}
    yield f"{data}: {plural(len(measured), 'frame')} of vehicles"
    for span in spans:
        yield f"    {span.attribute:<20}{span.sentence}"
    if rows is not None:
        yield f"{out}: {plural(rows, 'row')} of COD tables"


@odd.command()
@answer_json
def inside(
    data: Path = typer.Argument(help="Dataset folder."),
    domain: str = ODD,
    perceived: bool = typer.Option(
        False,
        "--perceived",
        help="Also as vehicles perceive it: by the weather network, detections and their tracks.",
    ),
    weather: Path | None = typer.Option(None, "--weather", help="Weather network; default: the package's."),
    objects: Path | None = typer.Option(None, "--objects", help="Weights of the detector; default: the package's."),
    device: Device = typer.Option(Device.auto, "--device", help="Where the networks run; auto: a GPU if there is one."),
    frames: Path | None = typer.Option(None, "--frames", help="Table to write, .csv or .parquet: a frame's verdict."),
) -> Answer:
    """Judge every frame of a recording's vehicles by a domain: inside, outside, or unknown.

    A verdict that rests on a missing value is unknown.
    """
    use_threads(1)
    import time

    from flcav.cli.options import refuse_unused
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.odd.domain import read_domain
    from flcav.odd.judge import compare_verdicts, describe_agreement, judge_frames, write_verdicts
    from flcav.odd.measure import measure_domain, scenery_of
    from flcav.storage.files import check_writable
    from flcav.storage.records import check_ending

    if not perceived:
        refuse_unused("odd inside without --perceived", "weather", "objects", "device")
    if frames is not None:
        check_ending(frames)
        check_writable(frames.parent)
    found = read_domain(domain)
    found.require_bound()
    recorded = Dataset.open(data)
    scenery = scenery_of(recorded)
    begun = time.perf_counter()
    truth = judge_frames(found, measure_domain(recorded, scenery=scenery))
    rate = len(truth.frames) / (time.perf_counter() - begun)
    seen, agreement = None, None
    if perceived:
        from flcav.odd.measure import perceive
        from flcav.perception.networks import resolve_network
        from flcav.perception.tasks import task_named

        networks = [
            resolve_network(task_named(name), weights, device.value)
            for name, weights in (("weather", weather), ("objects", objects))
        ]
        with progress.show_progress("perceived") as report:
            seen = judge_frames(found, perceive(found, recorded, truth.frames, *networks, progress=report))
        agreement = compare_verdicts(truth.verdict.tolist(), seen.verdict.tolist())
    if frames is not None:
        write_verdicts(recorded, truth, seen, frames)
    compared = None if agreement is None else agreement.as_json()
    yield {"domain": found.name, **truth.as_json(), "frames_per_s": rate, "perceived": compared}
    yield f"{found.name}: {truth.sentence}, by ground truth ({rate:,.0f} a second)"
    for module, count in truth.failed.items():
        yield f"    {module} puts {plural(count, 'frame')} outside"
    if seen is not None and agreement is not None:
        yield f"{found.name}: {seen.sentence}, as perceived"
        for line in describe_agreement(agreement):
            yield f"    {line}"


@odd.command()
@answer_json
def cover(
    domain: str = ODD,
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(..., "--out", help="Folder for the report, the matrix (HTML) and each run's coverage."),
    by: str = typer.Option("junction,light", "--by", metavar="X,Y", help="The two attributes of matrix and cells."),
    detect: bool = typer.Option(
        False,
        "--detect",
        help="Run the detector of objects: by cell its AP, errors, and the pole that covers most.",
    ),
    weights: Path | None = typer.Option(None, "--weights", help="Weights of the detector; default: the package's."),
    range_m: float = typer.Option(
        40.0, "--range", min=0.1, max=1e4, callback=check_finite, help="How far a pole's sensor covers errors [m]."
    ),
    device: Device = typer.Option(
        Device.auto, "--device", help="Where the detector runs; auto: a GPU if there is one."
    ),
) -> Answer:
    """Measure how much of a domain recordings cover, and with --detect where in it the detector errs.

    From a domain to where the network errs to where to look: a cell is a bucket of each of two attributes.
    """
    use_threads(1)
    from flcav.cli.options import parse_axes, refuse_unused
    from flcav.interface import progress
    from flcav.odd.coverage import cover_domain
    from flcav.odd.domain import read_domain
    from flcav.perception.networks import resolve_network
    from flcav.perception.objects.task import OBJECTS
    from flcav.storage.files import check_writable

    axes = parse_axes(by)
    if not detect:
        refuse_unused("odd cover without --detect", "weights", "range_m", "device")
    check_writable(out)
    found = read_domain(domain)
    with progress.show_progress("cover") as report:
        result = cover_domain(
            found,
            data,
            out,
            axes,
            network=resolve_network(OBJECTS, weights, device.value) if detect else None,
            range_m=range_m,
            progress=report,
        )
    yield result.as_json()
    yield result.sentences[0]
    for row in result.attributes:
        holes = f"; not covered: {', '.join(row.holes)}" if row.holes else ""
        yield f"    {row.attribute:<32}{row.grade:>4.0%}{holes}"
    for row in result.cells:
        yield _describe_cell(row)
    yield f"{out / 'matrix.html'}: {result.sentences[1]}"


@odd.command()
@answer_json
def tasks(
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(..., "--out", help="The run recipe to write (.yaml): flcav run reads it."),
    errors: Path | None = typer.Option(
        None, "--errors", help="Table of flcav errors: how dense a network's errors are is part of the complexity."
    ),
    pretrain: str = typer.Option("suburb", "--pretrain", help="Town of stage I; the other recorded towns federate."),
    wireless: float = typer.Option(180.0, "--wireless", min=0.001, callback=check_finite, help="Wireless budget [MB]."),
    wireline: float = typer.Option(110.0, "--wireline", min=0.001, callback=check_finite, help="Wireline budget [MB]."),
) -> Answer:
    """Generate tasks, {data, labels, network}, for the scenarios of recordings: more where a scenario is complex.

    The result is a run recipe, in which a task weighs as many of the scenarios as have it.
    """
    import yaml

    from flcav.config import InputError
    from flcav.odd.scenario_tasks import generate_tasks, make_run, name_region, town_of
    from flcav.storage.files import check_writable, write_bytes
    from flcav.world.map.town import load_town

    if out.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"--out {out}: a run recipe is a YAML file; name it {out.with_suffix('.yaml')}")
    check_writable(out.parent)
    load_town(pretrain)
    found = []
    if errors is not None:
        table = read_input_table(errors, ("x", "y", "scene"), ("scene",))
        places = numbers(table, ("x", "y"), errors).tolist()
        found = [(str(scene), *place) for scene, place in zip(table["scene"].to_pylist(), places, strict=True)]
    scenarios = [scenario for folder in data for scenario in generate_tasks(folder, found)]
    towns = {name_region(town): town for town in map(town_of, data)}
    recipe = make_run(scenarios, towns, pretrain, wireless, wireline)
    write_bytes(out, yaml.safe_dump(recipe, sort_keys=False).encode())
    rows = [scenario.as_json() | {"total": scenario.complexity.total} for scenario in scenarios]
    yield {"scenarios": rows, "recipe": recipe}
    for scenario in scenarios:
        parts = ", ".join(f"{name} {value:.2f}" for name, value in scenario.complexity.as_json().items())
        named = ", ".join(task.task for task in scenario.tasks)
        yield f"{scenario.town}, {scenario.kind}: complexity {scenario.complexity.total:.2f} ({parts})"
        yield f"    {plural(len(scenario.tasks), 'task')}: {named}"
    distinct = {task.task for scenario in scenarios for task in scenario.tasks}
    yield f"{out}: run recipe of {plural(len(distinct), 'task')}"


def _describe_cell(row: "CellErrors") -> str:
    covers = "" if row.pole is None else f"; pole {row.pole.pole} of {row.pole.town} covers {row.pole.covered}"
    return (
        f"    {' x '.join(row.cell):<32}{plural(row.frames, 'frame')}, AP50 {_words(row.precision)}, "
        f"{plural(row.errors, 'error')} ({row.misses} missed), {plural(row.failures, 'failure')}{covers}"
    )


def _words(estimate: "Estimate | None") -> str:
    return "of nothing" if estimate is None else estimate.describe()
