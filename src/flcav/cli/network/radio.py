"""`flcav radio`: the rates of a recording's connected vehicles at roadside units, and the coverage of its town."""

from pathlib import Path

import typer

from flcav.cli.options import check_png
from flcav.cli.terminal import echo, print_json

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


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(radio)


def radio(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    pole: list[int] = POLES,
    scene: str | None = SCENE,
    network: Path | None = NETWORK,
    seed: int = SEED,
    map_: Path | None = typer.Option(
        None, "--map", callback=check_png, help="PNG file: rate by place, line of sight, drives."
    ),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object, with the rates over time."),
) -> None:
    """Compute the radio rates of a recording's connected vehicles at roadside units.

    Path loss, blockage and shadowing by 3GPP TR 37.885, line of sight through the town's buildings and traffic. A rate
    is that of a vehicle that has the band to itself.
    """
    from dataclasses import asdict

    from flcav.config import read_config
    from flcav.dataset.store import Dataset
    from flcav.network.clock.rounds import NetworkSettings
    from flcav.network.radio.budget import PathState
    from flcav.network.radio.recorded import cover_town, link_scene, summarise_links
    from flcav.storage.files import check_writable, write_bytes

    if map_ is not None:
        check_writable(map_.parent)
    settings = NetworkSettings() if network is None else read_config(NetworkSettings, network)
    recorded = link_scene(Dataset.open(folder), settings.radio, pole, scene, seed)
    links, found = recorded.links, summarise_links(recorded.links)
    if map_ is not None:
        from flcav.report import style
        from flcav.report.pictures.coverage import coverage_map

        covered = cover_town(recorded.town, recorded.units, settings.radio)
        write_bytes(map_, style.png(coverage_map(recorded.town, covered, recorded.paths, links)))
    if as_json:
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
        print_json(
            {"scene": recorded.scene, "town": recorded.town.name, "time_s": links.time_s.tolist(), "links": rows}
        )
        return
    span_s = links.time_s[-1] - links.time_s[0]
    echo(f"{recorded.scene}: {len(links.time_s)} instants over {span_s:g} s in {recorded.town.name}")
    for row in found:
        rate = f"{row.mean_mbps:.1f} Mbit/s on average, {row.least_mbps:.1f} to {row.most_mbps:.1f}"
        shares = f"LOS {row.los:.0%}, NLOSv {row.nlosv:.0%}, NLOS {row.nlos:.0%}"
        echo(f"    {row.vehicle} at {row.unit}: {rate}; {shares}; {row.nearest_m:.0f} to {row.farthest_m:.0f} m")
    if map_ is not None:
        echo(f"{map_}: rate by place in {recorded.town.name}")
