"""`flcav radio` and `flcav rounds`: radio rates of a recording's vehicles, and the clock of federated rounds."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_all_finite, check_finite, check_png
from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.network.clock.rounds import NetworkSettings

POLES = typer.Option(
    [],
    "--pole",
    help="Number of a pole with a roadside unit; may be given several times. By default the recorded poles.",
)
SCENE = typer.Option(None, "--scene", help="Scene of the dataset; else the first.")
NETWORK = typer.Option(
    None, "--network", help="YAML of the network's settings: radio, wireline, rounds; see docs/network.md."
)
SEED = typer.Option(0, "--seed", min=0, help="Seed of shadowing and of the losses by vehicles.")


def read_radio_settings(path: Path | None) -> "NetworkSettings":
    """Return the network settings in a YAML file, or the defaults for None; raises `InputError` for measured rates."""
    from flcav.config import InputError, read_config
    from flcav.network.clock.rounds import NetworkSettings

    settings = NetworkSettings() if path is None else read_config(NetworkSettings, path)
    if settings.throughput is not None:
        raise InputError(f"{path}: throughput: measured rates are for `flcav run`, `rounds` and `allocate`, not here")
    return settings


@answer_json
def radio(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    pole: list[int] = POLES,
    scene: str | None = SCENE,
    network: Path | None = NETWORK,
    seed: int = SEED,
    map_: Path | None = typer.Option(
        None, "--map", callback=check_png, help="PNG file: rate by place, line of sight, drives."
    ),
) -> Answer:
    """Compute the radio rates of a recording's connected vehicles at roadside units.

    Path loss, blockage and shadowing by 3GPP TR 37.885, line of sight through the town's buildings and traffic. A rate
    is that of a vehicle that has the band to itself.
    """
    from dataclasses import asdict

    from flcav.dataset.store import Dataset
    from flcav.network.radio.budget import PathState
    from flcav.network.radio.recorded import cover_town, link_scene, summarise_links
    from flcav.storage.files import check_writable, write_bytes

    if map_ is not None:
        check_writable(map_.parent)
    settings = read_radio_settings(network)
    recorded = link_scene(Dataset.open(folder), settings.radio, pole, scene, seed)
    links, found = recorded.links, summarise_links(recorded.links)
    if map_ is not None:
        from flcav.report import style
        from flcav.report.pictures.coverage import coverage_map

        covered = cover_town(recorded.town, recorded.units, settings.radio)
        write_bytes(map_, style.png(coverage_map(recorded.town, covered, recorded.paths, links)))
    rates = links.rate_bps / 1e6
    states = {-1: None, **{int(state): state.name for state in PathState}}
    rows = []
    for row in found:
        at = (slice(None), links.vehicle.index(row.vehicle), links.unit.index(row.unit))
        series = {
            "rate_mbps": rates[at].tolist(),
            "distance_m": links.distance_m[at].tolist(),
            "state": [states[state] for state in links.state[at].tolist()],
        }
        rows.append({**asdict(row), **series})
    yield {"scene": recorded.scene, "town": recorded.town.name, "time_s": links.time_s.tolist(), "links": rows}
    span_s = links.time_s[-1] - links.time_s[0]
    yield f"{recorded.scene}: {len(links.time_s)} instants over {span_s:g} s in {recorded.town.name}"
    for row in found:
        rate = f"{row.mean_mbps:.1f} Mbit/s on average, {row.least_mbps:.1f} to {row.most_mbps:.1f}"
        shares = f"LOS {row.los:.0%}, NLOSv {row.nlosv:.0%}, NLOS {row.nlos:.0%}"
        yield f"    {row.vehicle} at {row.unit}: {rate}; {shares}; {row.nearest_m:.0f} to {row.farthest_m:.0f} m"
    if map_ is not None:
        yield f"{map_}: rate by place in {recorded.town.name}"


BYTES_PER_MB = 1_000_000


@answer_json
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
) -> Answer:
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
    if settings.throughput is None:
        links = link_scene(Dataset.open(folder), settings.radio, pole, scene, seed).links
    else:
        from flcav.network.radio.measured import link_measured, load_throughput

        assert network is not None
        measured = load_throughput(network.parent / settings.throughput)
        links = link_measured(measured, settings.radio, tuple(measured.rates["wireless"]))
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
    yield {"rounds": [asdict(record) for record in records]}
    for record in records:
        wire = record.wireline_down_s + record.wireline_up_s
        last = "nobody's update arrived" if record.straggler is None else f"{record.straggler.client} was last"
        yield (
            f"round {record.round}: {record.end_s - record.start_s:.2f} s"
            + (f", {wire:.2f} s of them wireline" if wire else "")
            + f"; {len(record.finished)} of {len(record.clients)} updates arrived, {last}"
        )
        for client in record.clients:
            spent = (
                f"download {client.download_s:.2f} s, compute {client.compute_s:.2f} s, upload {client.upload_s:.2f} s"
            )
            lost = f"; dropped at {client.end_s:.2f} s, {client.dropped}" if client.dropped else ""
            yield f"    {client.client} at {client.server}: {spent}{lost}"
    for path in (out, timeline):
        if path is not None:
            yield f"{path}: {plural(len(records), 'round')}"
