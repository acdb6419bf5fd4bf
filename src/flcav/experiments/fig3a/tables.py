"""Markdown tables of Fig. 3a."""

from flcav.experiments.fig3a.run import Fig3a
from flcav.optimization.curves.curves import STAGES
from flcav.optimization.curves.fitting import explain_exponent
from flcav.storage.markdown import format_bullets, format_table


def tables(results: Fig3a) -> dict[str, str]:
    """Return Markdown by name: findings, article, own, curve."""
    return {
        "findings": format_bullets(results.findings),
        "article": _article(results),
        "own": _own(results),
        "curve": _curve(results),
    }


def _article(results: Fig3a) -> str:
    rows = []
    for task, each in results.article.items():
        decay, printed, off = each.fitted.pretrain, each.printed, each.off
        constants = ((decay.a, printed.a, off.a), (decay.b, printed.b, off.b))
        cells = [f"{fitted:.4g} ({wanted:g}, {by:+.1%})" for fitted, wanted, by in constants]
        rows.append([task, len(each.points), *cells, f"{each.rmse:.3f}"])
    return format_table(("task", "points", "a (printed, off)", "b (printed, off)", "rmse of accuracy"), rows)


def _curve(results: Fig3a) -> str:
    """Return the decays that the error of the own curve is the sum of, and what there is to say of their exponents."""
    rows = []
    for stage, decay, name in zip(STAGES, results.own.curve.decays(), "xyz"):
        said = explain_exponent(stage, decay.b) or ""
        rows.append([stage, str(decay).replace("x", name), said.removeprefix(f"{stage}: ")])
    return format_table(("stage", "error", "note"), rows)


def _own(results: Fig3a) -> str:
    own = results.own
    rows = [
        [line.samples, len(line.points)]
        + [f"{line.accuracy[at]:.3f} ({line.low[at]:.3f} to {line.high[at]:.3f})" for at in (0, -1)]
        for line in own.lines
    ]
    edge, cloud = own.route[-1]
    header = ("samples", "points", "AP50 pretrained (95 % band)", f"after {edge} edge and {cloud} cloud rounds")
    return format_table(header, rows)
