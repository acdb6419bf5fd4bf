"""The demo: the whole story at a size that a laptop finishes in minutes, and the page that tells it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flcav.dataset.layout import package_versions
from flcav.dataset.store import Dataset
from flcav.experiments.findings import findings
from flcav.experiments.picture import look
from flcav.experiments.pipeline import cloud_step, edge_step, plan_step, rounds_step, shared_steps, test_step
from flcav.experiments.placing import ERRORS
from flcav.experiments.points import HISTORY_FILE, append_points, points_of
from flcav.experiments.pretraining import LEDGER
from flcav.experiments.protocol import REGIONS, Protocol, Split, Training
from flcav.experiments.recording import DATA
from flcav.experiments.steps import Notify, Step, run_steps
from flcav.experiments.testing import difference
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.files import write_bytes, write_json
from flcav.geometry import Boxes
from flcav.network.ledger import LINKS, Ledger
from flcav.perception.errors import load_errors
from flcav.perception.objects.truth import only_lidar
from flcav.report import figures, html, maps, style, sweeps
from flcav.world.town import load_town

EDGE, CLOUD = "grid-edge-chosen", "cloud"
STAGE_NAMES = {"pretrain": "pretrained", "edge": "edge FL", "cloud": "edge + cloud FL"}
ROUND_FRAMES = 30  # test frames that AP after each round is measured on


def demo_protocol(seed: int) -> Protocol:
    """Return the demo's size: what two cores do in under ten minutes."""
    return Protocol(
        seed=seed,
        pool=Split(scenes=16, spins=5, cavs=4),
        validation=Split(scenes=8, spins=2, cavs=3),
        registry=Split(scenes=8, spins=3, cavs=4),
        edge=Split(scenes=16, spins=5, cavs=4),
        test=Split(scenes=30, spins=1, cavs=4),
        training=Training(max_blocks=9),
    )


def demo_steps(protocol: Protocol, strategy: Strategy = FEDAVG) -> list[Step]:
    """Return the steps of the run itself and of the one comparison the demo makes: the densest pole.

    `strategy` is that of every federation: of both regions' vehicles, and of their edge servers with the cloud.
    """
    steps = shared_steps(protocol, plan_step(protocol))
    for town, sensor in (("grid", "chosen"), ("grid", "densest"), ("ring", "chosen")):
        steps.append(edge_step(protocol, town, sensor, strategy))
    steps.append(cloud_step(protocol, strategy))
    for town in REGIONS:
        steps += [test_step(arm, town) for arm in ("pretrain", f"{town}-edge-chosen", CLOUD)]
        steps += [rounds_step(arm, town, ROUND_FRAMES) for arm in (f"{town}-edge-chosen", CLOUD)]
    steps.append(test_step("grid-edge-densest", "grid"))
    arms = {"pretrained": "pretrain", "edge + cloud FL": CLOUD}
    needs = ("grid-test", *arms.values())
    return [*steps, Step("sweep", look, {"town": "grid", "arms": arms}, needs=needs)]


def run_demo(
    protocol: Protocol,
    out: Path,
    *,
    jobs: int,
    notify: Notify,
    clock: Callable[[], float],
    strategy: Strategy = FEDAVG,
) -> dict[str, Any]:
    """Run or finish the demo in the folder `out` and return its results; `clock()` gives the seconds spent so far."""
    work = out / "work"

    def noted(step: str, done: int, total: int, note: str) -> None:
        if note == "done":
            clock()
        notify(step, done, total, note)

    values = run_steps(demo_steps(protocol, strategy), work, jobs=jobs, notify=noted)
    append_points(out / HISTORY_FILE, points_of(values, f"seed{protocol.seed}"))
    results = {"strategy": repr(strategy)} | collect(protocol, work, values)
    results["elapsed_s"] = round(clock(), 1)
    results["findings"] = findings(results)
    pictures = draw(work, values, results)
    for name, png in pictures.items():
        write_bytes(out / "pictures" / f"{name}.png", png)
    page = {name: png for name, png in pictures.items() if name != "overview"}
    write_bytes(out / "report.html", html.render(results, page).encode())
    write_json(out / "results.json", results)
    return results


def collect(protocol: Protocol, work: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of a finished run."""
    planned = values["plan"]["tasks"][0]
    book = Ledger.load(work / CLOUD / LEDGER)
    tests = {town: values[f"test-pretrain-{town}"] for town in REGIONS}
    densest = values["test-grid-edge-densest-grid"]
    return {
        "seed": protocol.seed,
        "test_frames": tests["grid"]["frames"],
        "test_scenes": tests["grid"]["scenes"],
        "stages": _stages(values, book, "grid"),
        "ring": _stages(values, book, "ring"),
        "placement": {
            **values["grid-place"],
            "ap50_chosen": values[f"test-{EDGE}-grid"]["ap50"],
            "ap50_densest": densest["ap50"],
            "difference": _difference(work, protocol, "grid-edge-densest", EDGE),
        },
        "differences": {
            "edge_minus_pretrained": _difference(work, protocol, "pretrain", EDGE),
            "cloud_minus_edge": _difference(work, protocol, EDGE, CLOUD),
        },
        "allocation": {
            **{name: planned[name] for name in ("samples", "edge_rounds", "cloud_rounds", "predicted_error")},
            "vehicles": list(protocol.vehicles.values()),
        },
        "ledger": {
            link: {
                "budget_mb": getattr(book.budget, f"{link}_mb"),
                "used_mb": book.used_mb(link),
                "planned_mb": planned[f"{link}_mb"],
            }
            for link in LINKS
        },
        "ledger_by_stage": [
            {"stage": stage, "link": link, "mb": book.used_mb(link, stage=key)}
            for key, stage in (("pretrain", "pretraining"), ("edge", "edge FL"), ("cloud", "cloud FL"))
            for link in LINKS
        ],
        "rounds": _rounds(values),
        "versions": package_versions(),
    }


def _stages(values: dict[str, Any], book: Ledger, town: str) -> list[dict[str, Any]]:
    planned = values["plan"]["tasks"][0]
    frames = values[f"{town}-edge-chosen"]["samples"]
    rows = []
    for key, arm, samples, rounds in (
        ("pretrain", "pretrain", planned["samples"], 0),
        ("edge", f"{town}-edge-chosen", frames, planned["edge_rounds"]),
        ("cloud", CLOUD, values[CLOUD]["samples"], planned["cloud_rounds"]),
    ):
        test = values[f"test-{arm}-{town}"]
        rows.append(
            {
                "name": STAGE_NAMES[key],
                "town": town,
                **{name: test[name] for name in ("ap50", "ap50_low", "ap50_high", "ap70", "aos50", "right_headings")},
                "samples": samples,
                "rounds": rounds,
                **{f"{link}_mb": book.used_mb(link, stage=key) for link in LINKS},
            }
        )
    return rows


def _rounds(values: dict[str, Any]) -> list[dict[str, Any]]:
    rows = [
        {"stage": "pretraining", "round": row["block"], "town": "suburb", "ap50": row["ap50"]}
        for row in values["pretrain"]["curve"]
    ]
    for town in REGIONS:
        for stage, arm in (("edge FL", f"{town}-edge-chosen"), ("cloud FL", CLOUD)):
            rows += [{"stage": stage, "town": town, **row} for row in values[f"rounds-{arm}-{town}"]]
    return rows


def _difference(work: Path, protocol: Protocol, before: str, after: str) -> dict[str, float]:
    return difference(work / f"test-{before}-grid", work / f"test-{after}-grid", protocol.seed)


def draw(work: Path, values: dict[str, Any], results: dict[str, Any]) -> dict[str, bytes]:
    """Return the report's pictures as PNG files by name."""
    town, errors = load_town("grid"), load_errors(work / "grid-errors" / ERRORS)
    placed = results["placement"]
    scene = maps.ErrorMap(
        town,
        np.array([(error.x, error.y, error.z) for error in errors]).reshape(-1, 3),
        np.array([error.kind for error in errors], dtype=np.str_),
        maps.poles_of(town),
        (str(placed["chosen"]),),
        str(placed["densest"]),
        placed["range_m"],
    )
    sweep = _sweep(work, values["sweep"])
    stages = results["stages"] + results["ring"]
    budgets = {link: spent["budget_mb"] for link, spent in results["ledger"].items()}
    drawn = {
        "town_map": figures.town_map(scene),
        "before_after": figures.before_after(sweep),
        "ap_by_round": figures.ap_by_round(results["rounds"], stages),
        "megabytes": figures.megabytes(results["ledger_by_stage"], budgets),
        "overview": figures.overview(scene, sweep, results["rounds"], stages),
    }
    return {name: style.png(figure) for name, figure in drawn.items()}


def _sweep(work: Path, value: dict[str, Any]) -> sweeps.Sweep:
    frame = Dataset.open(work / "grid-test" / DATA).frame(value["frame"])
    lidar = only_lidar(frame)
    before, after = (
        sweeps.Detections(
            seen["name"],
            Boxes.from_array(np.array(seen["boxes"]), "Car"),
            np.array(seen["hit"], dtype=bool),
            np.array(seen["found"], dtype=bool),
        )
        for seen in value["seen"]
    )
    ground_m = -float(frame.world_from_sensor(lidar)[2, 3])
    targets = Boxes.from_array(np.array(value["targets"]), "Car")
    return sweeps.Sweep(frame.lidar[lidar], ground_m, targets, before, after)
