"""`flcav carla serve`: a server for clients of CARLA 0.9.16, without CARLA."""

import ipaddress
import logging
from pathlib import Path

import typer

from flcav.carla.server.blueprints import Quality
from flcav.cli.terminal import echo

carla = typer.Typer(help="CARLA: serve its clients from a town, without a GPU.", no_args_is_help=True)


@carla.callback()
def _group() -> None:
    pass


@carla.command()
def serve(
    town: str = typer.Argument(help="A town's name or folder, or a map of --maps."),
    port: int = typer.Option(2000, "--port", min=1, max=65534, help="Port of the calls; the next one is for streams."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of traffic, walkers and sensors."),
    traffic: int = typer.Option(0, "--traffic", min=0, max=1000, help="Vehicles of SUMO that drive by themselves."),
    maps: Path | None = typer.Option(None, "--maps", help="Folder with OpenDRIVE maps: NAME.xodr is served as NAME."),
    quality: Quality = typer.Option(
        Quality.HIGH, "--quality", help="Of colour images; low draws a quarter of the rays."
    ),
    host: str = typer.Option("127.0.0.1", "--host", help="Address to listen on; anyone who reaches it is served."),
) -> None:
    """Serve the clients of CARLA 0.9.16 until interrupted: their scripts run unchanged (docs/carla.md)."""
    from flcav.carla.server.calls import Calls
    from flcav.carla.server.maps import Maps
    from flcav.carla.server.serve import open_doors
    from flcav.carla.server.serve import serve_clients as serve_calls
    from flcav.carla.server.wire import VERSION

    logging.basicConfig(format="flcav: %(message)s", level=logging.WARNING)
    if not _is_loopback(host):
        echo(f"flcav: {host} is open to the network, and CARLA's protocol asks nobody for a password", err=True)
    doors = open_doors(host, port)
    calls = Calls(Maps(maps), town, seed=seed, traffic=traffic, port=port, quality=quality)
    calls.episode.warm_up()
    name = calls.episode.served.name
    note = "" if quality == Quality.HIGH else f"; colour images of {quality} quality"
    serve_calls(calls, doors, lambda: echo(f"{name}: ready for clients of CARLA {VERSION} at {host}:{port}{note}"))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
