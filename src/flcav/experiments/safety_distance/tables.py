"""Markdown tables of the trade-off of safety distances."""

from flcav.experiments.safety_distance.run import SafetyDistance
from flcav.storage.markdown import format_table


def safety_tables(results: SafetyDistance) -> dict[str, str]:
    """Return Markdown by name: settings, differences."""
    rows = [
        [
            each.name,
            str(each.faults),
            f"{each.hard_brakes:.2f}",
            f"{100 * each.near_share:.1f} %",
            f"{each.mean_speed:.2f}",
            f"{each.score:.3f}",
        ]
        for each in results.settings
    ]
    columns = ("margin", "collisions at fault", "hard brakes a drive", "time below 1.5 s", "mean speed [m/s]", "score")
    gaps = [[name, gap.describe(sign=True)] for name, gap in results.differences.items()]
    title = f"{results.compared[1]} less {results.compared[0]}"
    return {"settings": format_table(columns, rows), "differences": format_table((title, "mean, interval"), gaps)}
