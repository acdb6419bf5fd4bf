"""Markdown tables of Fig. 3b."""

from flcav.experiments.fig3b.run import Fig3b
from flcav.markdown import format_table


def tables(results: Fig3b) -> dict[str, str]:
    """Return Markdown by name: zones, placed."""
    zones = [
        [
            zone.pole,
            zone.kind,
            zone.errors,
            f"{zone.per_hectare:.0f}",
            "" if zone.per_frame is None else f"{zone.per_frame:.1f}",
            f"{zone.actors:.1f}",
        ]
        for zone in results.zones
    ]
    placed = [[each.count, each.rule, ", ".join(map(str, each.poles)), each.covered] for each in results.placed]
    header = ("pole", "zone", "errors", "per hectare", "per frame driven there", "actors in reach")
    return {
        "zones": format_table(header, zones),
        "placed": format_table(("sensors", "rule", "poles", "errors covered"), placed),
    }
