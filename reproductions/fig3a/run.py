"""Fig. 3a of Wang et al. (IEEE Network 37(3), 2023): the three-layer graph, and learning curves with confidence bands.

One set of curves is fitted to the points of the article, in its form accuracy = 1 - a x^(-b); the other to the history
of this package's runs, in the additive form that plans use.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.optimization.curves.bands import Bands, bootstrap_bands
from flcav.optimization.curves.curves import STAGES, Additive
from flcav.optimization.curves.fitting import Fit, explain_exponent, fit_additive
from flcav.optimization.curves.history import History, article_histories
from flcav.optimization.curves.levels import level_seeds
from flcav.optimization.graph import Layers, build_graph
from flcav.report import style
from flcav.report.charts import curves as curve_charts
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.tables import load_known_history
from flcav.storage.markdown import format_bullets, format_table
from flcav.storage.records import Record

Array = NDArray[np.float64]

PRINTED = {"weather": (11.84, 1.23), "signs": (8.15, 0.62), "objects": (0.51, 0.10)}  # a and b of the authors' software
NEAR = 0.03  # greatest relative deviation of fitted from printed constants that counts as near
LEVEL = 0.95  # confidence level of the bands


@dataclass(frozen=True)
class Constants:
    """The constants of the article's form accuracy = 1 - a x^(-b)."""

    a: float
    b: float


@dataclass(frozen=True)
class ArticleCurve:
    """The curve of one of the article's tasks, refitted to its points."""

    points: tuple[tuple[float, float], ...]  # samples, accuracy
    fitted: Additive
    printed: Constants
    off: Constants  # relative deviation, fitted / printed - 1
    rmse: float  # of accuracy
    resource: tuple[float, ...]  # numbers of samples of the following values
    accuracy: tuple[float, ...]
    low: tuple[float, ...]  # lower end of the band
    high: tuple[float, ...]


@dataclass(frozen=True)
class OwnLine:
    """The package's curve at one number of samples, along the rounds of a run."""

    samples: int
    accuracy: tuple[float, ...]  # along `OwnCurves.route`
    low: tuple[float, ...]  # lower end of the band
    high: tuple[float, ...]
    points: tuple[tuple[int, float], ...]  # index in the route, accuracy


@dataclass(frozen=True)
class OwnCurves:
    """The learning curve fitted to the package's history."""

    route: tuple[tuple[int, int], ...]  # edge rounds, cloud rounds
    curve: Additive
    rmse: float
    lines: tuple[OwnLine, ...]


@dataclass(frozen=True)
class Fig3a(Record):
    """Numbers of the figure: curves with points and bands, and findings about the fits."""

    article: Mapping[str, ArticleCurve]  # by task
    own: OwnCurves
    findings: tuple[str, ...]
    level: float  # confidence level of the bands
    provenance: Provenance


def fig3a() -> Fig3a:
    """Fit both sets of curves and return the numbers of the figure."""
    article = {task: _article_curve(points, PRINTED[task]) for task, points in article_histories().items()}
    own = _own_curves()
    return Fig3a(article, own, _findings(article, own), LEVEL, provenance())


def _article_curve(points: History, printed: tuple[float, float]) -> ArticleCurve:
    samples, edge_rounds, cloud_rounds = points.resources.T
    fit = fit_additive(samples, edge_rounds, cloud_rounds, points.accuracy)
    assert isinstance(fit.curve, Additive)
    decay = fit.curve.pretrain
    grid = np.geomspace(samples.min(), samples.max(), 60)
    where = np.column_stack((grid, np.zeros_like(grid), np.zeros_like(grid)))
    accuracy, low, high = _line(fit, bootstrap_bands(fit, level=LEVEL), where)
    return ArticleCurve(
        points=tuple(zip(samples.tolist(), points.accuracy.tolist(), strict=True)),
        fitted=fit.curve,
        printed=Constants(*printed),
        off=Constants(decay.a / printed[0] - 1, decay.b / printed[1] - 1),
        rmse=fit.rmse,
        resource=tuple(grid.tolist()),
        accuracy=accuracy,
        low=low,
        high=high,
    )


def _line(fit: Fit[Additive], bands: Bands | None, where: Array) -> tuple[tuple[float, ...], ...]:
    """Return the accuracy at `where` (n, 3), and the ends of its band, which are the accuracy without a band."""
    accuracy = 1 - fit.curve.error(*where.T)
    low, high = (accuracy, accuracy) if bands is None else (1 - error for error in bands.between(where)[::-1])
    return tuple(tuple(values.tolist()) for values in (accuracy, low, high))


def _own_curves() -> OwnCurves:
    """Return a line for each number of samples in the history, along pretraining, edge rounds and cloud rounds."""
    history = level_seeds(load_known_history("objects")).history
    samples, edge_rounds, cloud_rounds = history.resources.T
    fit = fit_additive(samples, edge_rounds, cloud_rounds, history.accuracy, history.weight)
    points = np.column_stack((history.resources, history.accuracy)).tolist()
    bands = bootstrap_bands(fit, level=LEVEL)
    route = [(e, 0) for e in range(int(edge_rounds.max()) + 1)]
    route += [(int(edge_rounds.max()), c) for c in range(1, int(cloud_rounds.max()) + 1)]
    place = {rounds: number for number, rounds in enumerate(route)}
    lines = []
    for count in np.unique(samples):
        accuracy, low, high = _line(fit, bands, np.array([(count, *rounds) for rounds in route], dtype=np.float64))
        measured = tuple((place[int(e), int(c)], float(y)) for x, e, c, y in points if x == count)
        lines.append(OwnLine(int(count), accuracy, low, high, measured))
    return OwnCurves(tuple(route), fit.curve, fit.rmse, tuple(lines))


def _findings(article: Mapping[str, ArticleCurve], own: OwnCurves) -> tuple[str, ...]:
    """Return the findings as sentences."""
    off = {(task, name): value for task, curve in article.items() for name, value in vars(curve.off).items()}
    (task, name), worst = max(off.items(), key=lambda item: abs(item[1]))
    near = all(abs(value) <= NEAR for value in off.values())
    points = sum(len(line.points) for line in own.lines)
    counts = ", ".join(str(line.samples) for line in own.lines)
    return (
        f"Refitted to the article's points, a and b come {'' if near else 'not '}within {NEAR:.0%} of the printed "
        f"constants; the farthest is {name} of {task}, {worst:+.1%} off.",
        f"Our own history has {points} points at {len(own.lines)} sample sizes ({counts}); its curve is off them by "
        f"{own.rmse:.3f} AP50 (root mean square), without the levels of its seeds.",
    )


def article_graph() -> nx.Graph:
    """Return the three-layer graph of the article's experiments: three tasks, seven vehicles, two edge servers."""
    networks = {
        "CNN": ("weather", 23.0, "camera", 700),
        "YOLOv5": ("signs", 14.0, "camera", 7000),
        "SECOND": ("objects", 60.0, "lidar", 3500),
    }
    limits = {"samples": (100, 5000), "edge_rounds": (0, 100), "cloud_rounds": (0, 100)}
    vehicles = {f"CAV {number}": "Town05" if number <= 4 else "Town03" for number in range(1, 8)}
    values = {
        "budgets_mb": {"wireless": 4000, "wireline": 4000},
        "tasks": {task: {"network": name, "weight": 1 / 3} for name, (task, *_) in networks.items()},
        "networks": {
            name: {
                "model_mb": model_mb,
                "modalities": [modality],
                "limits": limits,
                "curve": _effective(*PRINTED[task], group_samples),
            }
            for name, (task, model_mb, modality, group_samples) in networks.items()
        },
        "modalities": {"camera": {"sample_mb": 0.7}, "lidar": {"sample_mb": 1.6}},
        "vehicles": {name: {"edge": edge, "holds": {"camera": {}, "lidar": {}}} for name, edge in vehicles.items()},
    }
    return build_graph(parse_config(Layers, values, "the article's graph"))


def _effective(a: float, b: float, group_samples: int) -> dict[str, str | float]:
    return {"model": "effective", "a": a, "b": b, "alpha": 0.1, "beta": 0.5, "group_samples": group_samples}


def draw_fig3a(results: Fig3a) -> bytes:
    """Return the figure as a PNG: the graph, the article's curves, and the package's curves."""
    article = [
        curve_charts.Curve(
            f"{task}\n1 − {curve.fitted.pretrain.a:.3g}·x$^{{-{curve.fitted.pretrain.b:.2g}}}$",
            curve.resource,
            curve.accuracy,
            curve.low,
            curve.high,
            curve.points,
        )
        for task, curve in results.article.items()
    ]
    places = range(len(results.own.route))
    own = [
        curve_charts.Curve(f"{line.samples}\nsamples", places, line.accuracy, line.low, line.high, line.points)
        for line in results.own.lines
    ]
    return style.png(curve_charts.fig3a(article, own, results.own.route, article_graph()))


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
    for task, curve in results.article.items():
        decay, printed, off = curve.fitted.pretrain, curve.printed, curve.off
        constants = ((decay.a, printed.a, off.a), (decay.b, printed.b, off.b))
        cells = [f"{fitted:.4g} ({wanted:g}, {by:+.1%})" for fitted, wanted, by in constants]
        rows.append([task, len(curve.points), *cells, f"{curve.rmse:.3f}"])
    return format_table(("task", "points", "a (printed, off)", "b (printed, off)", "rmse of accuracy"), rows)


def _curve(results: Fig3a) -> str:
    """Return the decay terms of the package's curve, whose sum is the error, with notes on their exponents."""
    rows = []
    for stage, decay, name in zip(STAGES, results.own.curve.decays(), "xyz"):
        note = explain_exponent(stage, decay.b) or ""
        rows.append([stage, str(decay).replace("x", name), note.removeprefix(f"{stage}: ")])
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


def _run(out: Path, options: Options) -> Outcome[Fig3a]:
    results = fig3a()
    return Outcome(results, {"fig3a.png": draw_fig3a(results)}, results.findings)


EXPERIMENT = Experiment(Fig3a, _run, tables, takes=())
