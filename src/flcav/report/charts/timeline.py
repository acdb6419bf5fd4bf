"""Timeline of federated rounds: transfers and computation of every client, and of the wireline."""

from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flcav.network.clock.records import ClientTiming, RoundTiming
from flcav.report import style
from flcav.report.pictures.maps import HALO

WIRELINE = "wireline"
COLOURS = {"download": style.SKY, "compute": style.RULE, "upload": style.BLUE, WIRELINE: style.GREEN}


@style.styled
def timeline_of_rounds(records: Sequence[RoundTiming], width_in: float = 7.2) -> Figure:
    """Return the rounds as bars over time, with a row per client and one for the wireline.

    Raises ValueError without rounds.
    """
    if not records:
        raise ValueError("a timeline needs at least one round")
    seen = {client.client for record in records for client in record.clients}
    rows = sorted(seen, key=lambda name: (len(name), name))
    if any(record.wireline_down_s or record.wireline_up_s for record in records):
        rows.append(WIRELINE)
    figure = style.canvas(width_in, 1.3 + 0.42 * len(rows))
    axes = figure.add_subplot()
    origin = records[0].start_s
    for record in records:
        _draw_round(axes, record, rows, origin)
    axes.set_yticks(range(len(rows)), rows)
    axes.set(xlabel="seconds", ylim=(len(rows) - 0.5, -0.85), xlim=(0, (records[-1].end_s - origin) * 1.02))
    handles: list[Artist] = [
        Patch(color=colour, label=name) for name, colour in COLOURS.items() if name != WIRELINE or name in rows
    ]
    if any(client.dropped for record in records for client in record.clients):
        handles.append(_cross())
    style.key(figure, handles)
    return figure


def _draw_round(axes: Axes, record: RoundTiming, rows: Sequence[str], origin: float) -> None:
    for client in record.clients:
        _draw_client(axes, client, rows.index(client.client), origin)
    if WIRELINE in rows:
        bars = [(record.start_s - origin, record.wireline_down_s)]
        bars.append((record.end_s - record.wireline_up_s - origin, record.wireline_up_s))
        bars = [bar for bar in bars if bar[1] > 0]
        axes.broken_barh(bars, (rows.index(WIRELINE) - 0.3, 0.6), color=COLOURS[WIRELINE], linewidth=1)
    axes.axvline(record.end_s - origin, color=style.MUTED, linewidth=0.8, linestyle=(0, (3, 2)), zorder=0)
    middle = (record.start_s + record.end_s) / 2 - origin
    axes.text(
        middle,
        -0.6,
        f"round {record.round}: {record.end_s - record.start_s:.1f} s",
        ha="center",
        fontsize=style.SMALL,
        color=style.MUTED,
    )


def _draw_client(axes: Axes, client: ClientTiming, row: int, origin: float) -> None:
    """Draw a client's bars, and a cross with the reason where it was dropped."""
    begins = client.start_s - origin
    for name, spent in zip(COLOURS, (client.download_s, client.compute_s, client.upload_s)):
        axes.barh(row, spent, left=begins, height=0.6, color=COLOURS[name])
        begins += spent
    if client.dropped:
        axes.plot(client.end_s - origin, row, "x", color=style.VERMILLION, markersize=7, markeredgewidth=2)
        look = {"textcoords": "offset points", "va": "center", "fontsize": style.SMALL, "color": style.VERMILLION}
        look["path_effects"] = HALO
        axes.annotate(client.dropped, (client.end_s - origin, row), (8, 0), **look)


def _cross() -> Line2D:
    return Line2D([], [], linestyle="", marker="x", color=style.VERMILLION, markeredgewidth=2, label="dropped")
