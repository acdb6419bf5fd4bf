"""`flcav rounds`: the time of federated rounds over the radio of a recording."""

from pathlib import Path

import typer

from flcav.cli.network.radio import NETWORK, POLES, SCENE, SEED
from flcav.cli.options import check_all_finite, check_finite, check_png
from flcav.cli.terminal import echo, print_json
from flcav.interface.wording import plural

BYTES_PER_MB = 1_000_000


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(rounds)


def rounds(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    model_mb: float = typer.Option(
        ..., "--model-mb", min=0, max=1e6, callback=check_finite, help="Size of the model that vehicles receive [MB]."
    ),
    update_mb: float | None = typer.Option(
        None,
        "--update-mb",
        min=0,
        max=1e6,
        callback=check_finite,
        help="Size of the update that each sends; by default that of the model [MB].",
    ),
    steps: int = typer.Option(20, "--steps", min=0, max=1_000_000_000, help="Local steps of a round."),
    step_s: list[float] = typer.Option(
        [0.1],
        "--step-s",
        min=0,
        max=1e6,
        callback=check_all_finite,
        help="Time of a local step [s]; several are assigned to the vehicles round-robin.",
    ),
    count: int = typer.Option(1, "--rounds", min=1, max=100_000, help="Edge rounds, one after another."),
    edge_rounds_per_cloud_round: int | None = typer.Option(
        None,
        "--edge-rounds-per-cloud-round",
        "-k",
        min=1,
        help="Exchange the model with the cloud, by wireline, after as many; by default never.",
    ),
    pole: list[int] = POLES,
    scene: str | None = SCENE,
    network: Path | None = NETWORK,
    seed: int = SEED,
    out: Path | None = typer.Option(None, "--out", help="Parquet file: a row per vehicle and round."),
    timeline: Path | None = typer.Option(None, "--timeline", callback=check_png, help="PNG file: who did what when."),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Simulate the clock of federated rounds among a recording's connected vehicles.

    Each vehicle downloads the model from the nearest roadside unit, trains, and uploads its update, at the rate that it
    has where it drives; the band is shared. A vehicle that leaves the town or the coverage, or comes nearer to another
    unit, drops out by name, and the round goes on.
    """
    from dataclasses import asdict

    from flcav.config import read_config
    from flcav.dataset.store import Dataset
    from flcav.network.clock.records import ClientWork, save_rounds
    from flcav.network.clock.rounds import NetworkSettings, simulate_rounds
    from flcav.network.radio.recorded import link_scene
    from flcav.storage.files import check_writable, write_bytes

    for path in (out, timeline):
        if path is not None:
            check_writable(path.parent)
    settings = NetworkSettings() if network is None else read_config(NetworkSettings, network)
    links = link_scene(Dataset.open(folder), settings.radio, pole, scene, seed).links
    down = round(model_mb * BYTES_PER_MB)
    up = down if update_mb is None else round(update_mb * BYTES_PER_MB)
    work = {
        vehicle: ClientWork(vehicle, down, steps * step_s[number % len(step_s)], up)
        for number, vehicle in enumerate(links.vehicle)
    }
    records = simulate_rounds(
        links, [work] * count, settings, edge_rounds_per_cloud_round=edge_rounds_per_cloud_round, model_bytes=down
    )
    if out is not None:
        save_rounds(records, out)
    if timeline is not None:
        from flcav.report import style
        from flcav.report.charts.timeline import timeline_of_rounds

        write_bytes(timeline, style.png(timeline_of_rounds(records)))
    if as_json:
        print_json({"rounds": [asdict(record) for record in records]})
        return
    for record in records:
        wire = record.wireline_down_s + record.wireline_up_s
        last = "nobody's update arrived" if record.straggler is None else f"{record.straggler.client} was last"
        echo(
            f"round {record.round}: {record.end_s - record.start_s:.2f} s"
            + (f", {wire:.2f} s of them wireline" if wire else "")
            + f"; {len(record.finished)} of {len(record.clients)} updates arrived, {last}"
        )
        for client in record.clients:
            spent = (
                f"download {client.download_s:.2f} s, compute {client.compute_s:.2f} s, upload {client.upload_s:.2f} s"
            )
            lost = f"; dropped at {client.end_s:.2f} s, {client.dropped}" if client.dropped else ""
            echo(f"    {client.client} at {client.server}: {spent}{lost}")
    for path in (out, timeline):
        if path is not None:
            echo(f"{path}: {plural(len(records), 'round')}")
