"""`flcav drive`: closed-loop drives through scenarios, on perception or ground truth."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.domains.importance import ERRORS, FIRST_SEED, Perceives, read_model
from flcav.cli.options import JOBS, check_finite, refuse_unused
from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flcav.driving.film import Film
    from flcav.driving.measures import DriveResult


@answer_json
def drive(
    scenario: list[str] = typer.Option(
        [],
        "--scenario",
        help="Name of a scenario, a recipe (YAML), a recording, or OpenSCENARIO (.xosc); several times. By default "
        "all of the package.",
    ),
    listed: bool = typer.Option(False, "--list", help="Print the scenarios that would be driven, and drive none."),
    night: bool = typer.Option(False, "--night", help="Drive at night, in the rain and the sight of the scenario."),
    out: Path | None = typer.Option(
        None, "--out", help="Folder for report.html with the film, the table drives.csv, and results.json."
    ),
    seeds: int = typer.Option(1, "--seeds", min=1, max=100, help="Seeds of each."),
    first_seed: int = FIRST_SEED,
    perception: Perceives = typer.Option(
        Perceives.truth, "--perception", help="truth: ground truth; model: the networks' errors; networks: themselves."
    ),
    errors: Path | None = ERRORS,
    lasts: float = typer.Option(
        30.0, "--lasts", min=1.0, max=600.0, callback=check_finite, help="Length of a drive [s]."
    ),
    margin: float = typer.Option(
        0.4, "--margin", min=0.0, max=3.0, callback=check_finite, help="Distance kept free around road users [m]."
    ),
    sigmas: float = typer.Option(
        0.0,
        "--sigmas",
        min=0.0,
        max=10.0,
        callback=check_finite,
        help="Multiple of the standard deviation of predicted places that is kept free, too.",
    ),
    pole: list[int] = typer.Option(
        [], "--pole", help="Number of a pole that sends what it finds, with --perception networks; several times."
    ),
    lanes: bool = typer.Option(
        False,
        "--lanes",
        help="With --perception networks: drive each along the map's route and along the lanes that the camera sees, "
        "and compare the lateral errors.",
    ),
    measure: Path | None = typer.Option(
        None, "--measure", help="JSON file to write: the errors of the networks on these drives."
    ),
    jobs: int = JOBS,
) -> Answer:
    """Drive through scenarios in closed loop, and print progress, every infraction, and what the vehicle stood before.

    The first line says what perceives: ground truth, unless --perception says otherwise.
    """
    from flcav.config import InputError
    from flcav.driving.driver import DriverSettings
    from flcav.driving.film import Film
    from flcav.driving.jobs import DriveJob, Sensed, film_jobs, run_jobs
    from flcav.driving.loop import Loop
    from flcav.driving.measures import describe_drives
    from flcav.driving.scenario_files import read_scenarios
    from flcav.driving.scenarios import DrivingScenario
    from flcav.driving.studies.error_measurement import measure_errors
    from flcav.driving.studies.lane_gain import measure_lane_gain
    from flcav.driving.studies.pole_gain import measure_pole_gain
    from flcav.interface.progress import show_progress
    from flcav.storage.files import check_writable, write_json
    from flcav.storage.records import to_json

    chosen, numbers = read_scenarios(scenario), range(first_seed, first_seed + seeds)
    if night:
        chosen = tuple(each.at_night() for each in chosen)
    if listed:
        yield {"scenarios": [to_json(each, DrivingScenario) for each in chosen]}
        yield from (each.line() for each in chosen)
        return
    for option, given in (("--pole", bool(pole)), ("--lanes", lanes), ("--measure", measure is not None)):
        if given and perception != Perceives.networks:
            raise InputError(f"{option}: needs --perception networks, since sensors are simulated")
    if pole and lanes:
        raise InputError("--lanes: compares drives of the vehicle alone, without --pole")
    if lanes and measure is not None:
        raise InputError("--measure: measures the networks along the map's route, without --lanes")
    if pole and measure is not None:
        raise InputError("--measure: measures the vehicle's networks alone, without --pole")
    if pole:
        refuse_unused("drive --pole", "jobs")
    if pole and len({each.town for each in chosen}) > 1:
        raise InputError("--pole: needs scenarios of one town, --scenario")
    if measure is not None:
        check_writable(measure.parent)
    if out is not None:
        if pole or lanes or measure is not None:
            raise InputError("--out: writes the report of drives, without --pole, --lanes and --measure")
        check_writable(out)
    sensed = Sensed(perception.value, read_model(perception, errors))
    loop = Loop(DriverSettings(margin, sigmas), lasts)
    if measure is not None:
        with show_progress("measure") as report:
            found = measure_errors(chosen, numbers, loop, jobs, report)
        write_json(measure, found.as_json())
        yield found.as_json()
        yield f"{measure}: errors of the networks in {plural(found.frames, 'frame')}"
        return
    if pole:
        with show_progress("drive") as report:
            gain = measure_pole_gain(chosen, numbers, pole, loop, report)
        yield gain.as_json()
        yield from gain.lines()
        return
    if lanes:
        with show_progress("drive") as report:
            compared = measure_lane_gain(chosen, numbers, loop, jobs, report)
        yield compared.as_json()
        yield from compared.lines()
        return
    with show_progress("drive") as report:
        tasks = [DriveJob(each, seed, loop=loop) for each in chosen for seed in numbers]
        if out is None:
            drives, films = run_jobs(tasks, sensed, jobs, report), list[Film]()
        else:
            drives, films = (list(each) for each in zip(*film_jobs(tasks, sensed, jobs, report), strict=True))
    if out is not None:
        write_drives(out, sensed.line(), drives, films)
    yield {"perception": sensed.line(), "drives": [result.as_json() for result in drives]}
    yield sensed.line()
    for result in drives:
        yield result.line()
    yield describe_drives(drives)
    if out is not None:
        yield f"{out / 'report.html'}: measures with intervals, the drives, and their film"


def write_drives(out: Path, perceives: str, drives: "Sequence[DriveResult]", films: "Sequence[Film]") -> None:
    """Write report.html, drives.csv and results.json into a folder."""
    from flcav.report.pages.drive_page import drive_page, tabulate_drives
    from flcav.storage.files import write_bytes, write_json
    from flcav.storage.records import write_any_table

    out.mkdir(parents=True, exist_ok=True)
    write_any_table(tabulate_drives(drives), out / "drives.csv")
    write_json(
        out / "results.json", {"perception": perceives, "drives": [result.as_json() for result in drives]}, sort=False
    )
    write_bytes(out / "report.html", drive_page(perceives, drives, films).encode())
