"""What each step buys, against its alternatives: seven arms on the same frames, from the same weights, over seeds.

Every arm takes as many optimiser steps as the vehicles of stage II take together, and has a ledger of its own. Within a
seed, intervals redraw test scenes; over seeds, they are Student's t, so they hold what training and traffic vary too.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flcav.dataset.layout import package_versions
from flcav.experiments.demo import demo_protocol
from flcav.experiments.pipeline import central_step, cloud_step, edge_step, plan_step, shared_steps, test_step
from flcav.experiments.points import HISTORY_FILE, append_points, points_of
from flcav.experiments.pretraining import LEDGER
from flcav.experiments.protocol import Protocol
from flcav.experiments.steps import Notify, Step, run_side_by_side
from flcav.experiments.testing import difference
from flcav.intervals import mean_over_seeds
from flcav.network.ledger import LINKS, Ledger
from flcav.report import figures, style

MORE, ORACLE = "more-pretraining", "oracle"
ARMS = {
    "grid": {
        "pretrained": "pretrain",
        "more pretraining": MORE,
        "edge FL, no road sensor": "grid-edge-none",
        "edge FL, densest pole": "grid-edge-densest",
        "edge FL, VRCSP pole": "grid-edge-chosen",
        "edge + cloud FL": "cloud",
        "oracle": ORACLE,
    },
    "ring": {
        "pretrained": "pretrain",
        "more pretraining": MORE,
        "edge FL, VRCSP pole": "ring-edge-chosen",
        "edge + cloud FL": "cloud",
    },
}
COMPARED = (  # (after, before): claims of the article and controls
    ("edge FL, VRCSP pole", "pretrained"),
    ("edge FL, VRCSP pole", "more pretraining"),
    ("edge FL, VRCSP pole", "edge FL, no road sensor"),
    ("edge FL, VRCSP pole", "edge FL, densest pole"),
    ("edge + cloud FL", "edge FL, VRCSP pole"),
)


def arms_protocol(seed: int, scale: str) -> Protocol:
    """Return the reproduction's size: "paper" as committed, "quick" the demo's."""
    return Protocol(seed=seed) if scale == "paper" else demo_protocol(seed)


def arm_steps(protocol: Protocol) -> list[Step]:
    """Return the steps of all arms of one seed."""
    steps = shared_steps(protocol, plan_step(protocol))
    steps += [edge_step(protocol, "grid", sensor) for sensor in ("chosen", "densest", "none")]
    steps += [edge_step(protocol, "ring", "chosen"), cloud_step(protocol)]
    steps += [central_step(protocol, MORE, "suburb"), central_step(protocol, ORACLE, "grid")]
    return steps + [test_step(arm, town) for town, arms in ARMS.items() for arm in arms.values()]


def run_arms(protocols: Sequence[Protocol], out: Path, *, jobs: int, notify: Notify) -> dict[str, Any]:
    """Run or finish all arms of each seed in folders below `out` and return the results."""
    folders = [out / f"seed{protocol.seed}" for protocol in protocols]
    runs = {folder: arm_steps(protocol) for folder, protocol in zip(folders, protocols, strict=True)}
    values = run_side_by_side(runs, jobs=jobs, notify=notify)
    for folder in folders:
        append_points(out / HISTORY_FILE, points_of(values[folder], folder.name))
    seeds = [_one_seed(protocol, folder, values[folder]) for protocol, folder in zip(protocols, folders, strict=True)]
    return {
        "protocol": protocols[0].model_dump(mode="json", exclude={"seed"}),
        "seeds": seeds,
        "summary": summarise(seeds),
        "versions": package_versions(),
        "note": "road labels come from an ideal road detector: arms with a pole are upper bounds",
    }


def _one_seed(protocol: Protocol, folder: Path, values: dict[str, Any]) -> dict[str, Any]:
    ap = {town: {arm: values[f"test-{step}-{town}"] for arm, step in arms.items()} for town, arms in ARMS.items()}
    differences = {
        f"{town}: {after} - {before}": difference(
            folder / f"test-{ARMS[town][before]}-{town}", folder / f"test-{ARMS[town][after]}-{town}", protocol.seed
        )
        for town in ARMS
        for after, before in COMPARED
        if {after, before} <= set(ARMS[town])
    }
    grid = ap["grid"]
    start, end = grid["pretrained"]["ap50"], grid["oracle"]["ap50"]
    pretraining = values["pretrain"]
    return {
        "seed": protocol.seed,
        "plan": {name: values["plan"]["tasks"][0][name] for name in ("samples", "edge_rounds", "cloud_rounds")},
        "pretraining": {name: pretraining[name] for name in ("steps", "threshold", "curve")},
        "placement": {town: values[f"{town}-place"] for town in ARMS},
        "ap": ap,
        "differences": differences,
        "gap_closed": {
            arm: (test["ap50"] - start) / (end - start)
            for arm, test in grid.items()
            if arm not in ("pretrained", "oracle")
        },
        "used_mb": {
            arm: _used_mb(folder, step) for arm, step in ARMS["grid"].items() if (folder / step / LEDGER).exists()
        },
    }


def _used_mb(folder: Path, step: str) -> dict[str, float]:
    """Return what an arm has spent; stage II books in ledgers of its own, which stage I came before."""
    books = [Ledger.load(folder / step / LEDGER)]
    if step.startswith("grid-edge-"):
        books.append(Ledger.load(folder / "pretrain" / LEDGER))
    return {link: sum(book.used_mb(link) for book in books) for link in LINKS}


def summarise(seeds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means over seeds with their 95 % intervals."""
    first = seeds[0]
    return {
        "ap50": {
            town: {arm: mean_over_seeds([seed["ap"][town][arm]["ap50"] for seed in seeds]) for arm in arms}
            for town, arms in first["ap"].items()
        },
        "ap70": {
            town: {arm: mean_over_seeds([seed["ap"][town][arm]["ap70"] for seed in seeds]) for arm in arms}
            for town, arms in first["ap"].items()
        },
        "differences": {
            name: mean_over_seeds([seed["differences"][name]["mean"] for seed in seeds])
            for name in first["differences"]
        },
        "gap_closed": {
            arm: mean_over_seeds([seed["gap_closed"][arm] for seed in seeds]) for arm in first["gap_closed"]
        },
    }


def draw_arms(results: dict[str, Any]) -> bytes:
    """Return the forest plot of all arms' AP over seeds as a PNG."""
    rows = [
        {"arm": arm, "town": town, "ap50": ap["mean"], "low": ap["low"], "high": ap["high"]}
        for town, arms in results["summary"]["ap50"].items()
        for arm, ap in arms.items()
    ]
    return style.png(figures.arms(rows))
