"""Markdown tables of the search of a network."""

from flcav.experiments.networks.run import TOWNS, NetworksResult
from flcav.storage.markdown import format_table


def networks_tables(results: NetworksResult) -> dict[str, str]:
    """Return Markdown by name: networks."""
    rows = []
    for name, own in results.networks.items():
        ap50, ap70 = ([ap[town].describe() for town in TOWNS] for ap in (own.ap50, own.ap70))
        cost = (f"{own.parameters / 1e6:.2f} M", f"{own.share:.2f}", f"{own.seconds:.0f}")
        rows.append([name, *cost, *ap50, *ap70, "yes" if name in results.front else ""])
    titles = [f"{measure}, {town}" for measure in ("AP50", "AP70") for town in TOWNS]
    head = ("network", "parameters", "CPU time of training, share", "in seconds", *titles, "on the front")
    return {"networks": format_table(head, rows)}
