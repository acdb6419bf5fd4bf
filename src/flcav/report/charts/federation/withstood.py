"""Chart of accuracy under the worst attack against the share of attackers: a panel for each unlikeness."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from flcav.report import style

COLOURS = {
    "mean": style.MUTED,
    "median": style.BLUE,
    "trimmed mean": style.ORANGE,
    "Krum": style.VERMILLION,
    "multi-Krum": style.GREEN,
}
MIXED = "mixing, "  # begins the names of rules after mixing


@style.styled
def draw_withstood(
    shares: Sequence[float], lines: Mapping[str, Mapping[str, Sequence[float]]], best: Mapping[str, float]
) -> Figure:
    """Return the figure; `lines`: by panel and rule the accuracy at each share, `best`: that without an attack."""
    figure = style.canvas(9.0, 3.8)
    for number, (name, rules) in enumerate(lines.items(), 1):
        axes = figure.add_subplot(1, len(lines), number)
        axes.axhline(best[name], color=style.INK, linewidth=1, linestyle=(0, (6, 3)), label="mean, no attack")
        for rule, accuracy in rules.items():
            plain = rule.removeprefix(MIXED)
            dash = "-" if rule.startswith(MIXED) else (0, (2, 2))
            axes.plot(shares, accuracy, marker="o", markersize=3.5, color=COLOURS[plain], linestyle=dash, label=rule)
        axes.set(title=name, ylim=(-0.02, 1.02), xlabel="attackers [%]")
        axes.set_xticks(shares)
        axes.grid(axis="y")
        if number > 1:
            axes.set_yticklabels([])
    figure.axes[0].set_ylabel("accuracy under the worst attack")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure
