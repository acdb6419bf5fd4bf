"""Markdown tables of the comparison of exchanges."""

from collections.abc import Callable

import numpy as np

from flcav.experiments.cloud_rounds import format_divergence
from flcav.experiments.exchanges.run import (
    NO_CLOUD,
    NONE,
    OWN,
    UNSEEN,
    WHOLE,
    ExchangeArm,
    ExchangeResult,
    judge_differences,
)
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED
from flcav.storage.markdown import format_table

WORDS = {HELD: "higher", NOT_HELD: "lower", UNDECIDED: UNDECIDED}  # of the claim that a difference is positive


def tables(results: ExchangeResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, costs, differences, cloud; the last is empty where it was not measured."""
    found = {"accuracy": _accuracy(results), "costs": _costs(results), "differences": _differences(results)}
    return found | {"cloud": _cloud(results)}


def _accuracy(results: ExchangeResult) -> str:
    def tell(name: str, place: str) -> str:
        return results.accuracy[name][place].describe() if place in results.accuracy[name] else ""

    rows = [
        [group, name, *(tell(name, place) for place in results.places)]
        for group, names in results.groups.items()
        for name in names
    ]
    measured = (f"{results.measure}, {place}" for place in results.places)
    return format_table(("", f"arm, {len(results.seeds)} seeds", *measured), rows)


def _costs(results: ExchangeResult) -> str:
    def mean(name: str, number: Callable[[ExchangeArm], float | None], digits: int) -> str:
        known = [value for seed in results.seeds.values() if (value := number(seed[name])) is not None]
        return f"{np.mean(known):.{digits}f}" if known else ""

    numbers: tuple[tuple[Callable[[ExchangeArm], float | None], int], ...] = (
        (lambda each: each.wireless_up_mb, 3),
        (lambda each: each.wireless_down_mb, 2),
        (lambda each: each.wireline_up_mb, 3),
        (lambda each: each.wireline_down_mb, 2),
        (lambda each: each.clients, 1),
        (lambda each: each.seconds, 2),
    )
    rows = []
    for names in results.groups.values():
        for name in names:
            if name != NONE:
                private = next(iter(results.seeds.values()))[name].epsilon  # the same in all seeds
                epsilon = "∞" if private is None else f"{float(f'{private:.3g}'):,g}"
                rows.append([name, *(mean(name, number, digits) for number, digits in numbers), epsilon])
    links = (f"{link} {way}, MB" for link in ("wireless", "wireline") for way in ("up", "down"))
    return format_table(("arm", *links, "vehicles in a round of a region", "s a round", "ε"), rows)


def _differences(results: ExchangeResult) -> str:
    judged, rows = judge_differences(results), []
    for name in (each for names in results.groups.values() for each in names if each in results.differences):
        one, places = judged[name], results.differences[name]
        shown = [place for place in (OWN, UNSEEN) if place in results.places]
        told = [places[place].describe(sign=True) if place in places else "" for place in shown]
        rows.append([name, told[0], one.p_cell, WORDS[one.verdict], one.takes_cell, *told[1:]])
    header = (
        "arm",
        f"{results.measure} - that of whole weights, {OWN}",
        "p, corrected",
        "verdict",
        "if undecided: seeds that detect a difference of the observed size",
        *([f"the same, {UNSEEN}"] if UNSEEN in results.places else []),
    )
    return format_table(header, rows)


def _cloud(results: ExchangeResult) -> str:
    """Return the divergence of the regions in each seed beside what the cloud rounds gain in the own region."""
    if not results.divergence:
        return ""
    seeds = {seed: results.seeds[seed] for seed in results.divergence}
    gain = [arms[WHOLE].accuracy[OWN] - arms[NO_CLOUD].accuracy[OWN] for arms in seeds.values()]
    names = [f"seed {seed}" for seed in seeds]
    return format_divergence(names, [*results.divergence.values()], {f"{OWN}: cloud - edge FL": gain})
