"""Steps between stages I and II: the pretrained network's errors in a town, and the pole that covers them."""

from typing import Any

import numpy as np

from flcav.dataset.layout import trace_path
from flcav.experiments.pretraining import WEIGHTS
from flcav.experiments.protocol import Protocol
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.optimization.placement import coverage, place
from flcav.perception.errors import FALSE_POSITIVE, MISS, load_errors, save_errors
from flcav.perception.objects.detect import detect_all
from flcav.perception.objects.errors import register_errors
from flcav.perception.objects.weights import load_network
from flcav.world.density import poles_density
from flcav.world.town import load_town
from flcav.world.trace import Trace

ERRORS = "errors.parquet"


def register(work: Work, town: str) -> dict[str, int]:
    """Drive the pretrained network through a town it has not seen and register what it gets wrong."""
    drive = opened(work, f"{town}-registry")
    network = load_network(work.inputs["pretrain"] / WEIGHTS)
    frames = [drive.frame(i) for i in range(len(drive))]
    detections = detect_all(network, [frame.lidar["lidar"] for frame in frames])
    errors = register_errors(frames, detections, network.config, threshold=work.result("pretrain")["threshold"])
    save_errors(errors, work.folder / ERRORS)
    return {kind: sum(error.kind == kind for error in errors) for kind in (MISS, FALSE_POSITIVE)}


def choose_pole(work: Work, town: str, protocol: dict[str, Any]) -> dict[str, Any]:
    """Choose the pole that covers the most errors (VRCSP), and name the one with the densest traffic beside it."""
    setting = Protocol.model_validate(protocol)
    errors = load_errors(work.inputs[f"{town}-errors"] / ERRORS)
    xyz = np.array([(error.x, error.y, error.z) for error in errors]).reshape(-1, 3)
    here = load_town(town)
    placement = place(xyz, here.poles.position, setting.placement_range_m, 1)
    drive = opened(work, f"{town}-registry")
    traces = [Trace.load(drive.folder / trace_path(scene)) for scene in sorted({key.scene for key in drive.keys})]
    actors = poles_density(here, traces, setting.placement_range_m)
    covered = coverage(xyz, here.poles.position, setting.placement_range_m).sum(axis=1)
    return {
        "chosen": int(here.poles.id[placement.chosen[0]]),
        "densest": int(here.poles.id[int(np.argmax(actors))]),
        "errors": len(xyz),
        "covered": placement.covered,
        "range_m": setting.placement_range_m,
        "coverage": [
            {"pole": int(pole), "covered": int(count), "actors": round(float(mean), 2)}
            for pole, count, mean in zip(here.poles.id, covered, actors, strict=True)
        ],
    }
