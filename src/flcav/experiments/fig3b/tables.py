"""Markdown tables of Fig. 3b."""

from flcav.experiments.fig3b.cover import ASKED, REACHED
from flcav.experiments.fig3b.run import COUNTS, Fig3b
from flcav.storage.markdown import format_table


def tables(results: Fig3b) -> dict[str, str]:
    """Return Markdown by name: zones, placed, towns."""
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
    towns = [
        [
            each.town,
            each.errors,
            each.poles,
            *(f"{each.shares[count - 1]:.0%}" for count in COUNTS),
            f"{each.shares[-1]:.0%}",
            *("" if wanted is None else wanted for wanted in each.wanted),
            *(each.count_for_reached(share) for share in REACHED),
        ]
        for each in results.towns
    ]
    covered = (*(f"covered by {count}" for count in COUNTS), "by all poles")
    asked = (
        *(f"sensors for {share:.0%}" for share in ASKED),
        *(f"for {share:.0%} of those in reach" for share in REACHED),
    )
    return {
        "towns": format_table(("town", "errors", "poles", *covered, *asked), towns),
        "zones": format_table(header, zones),
        "placed": format_table(("sensors", "rule", "poles", "errors covered"), placed),
    }
