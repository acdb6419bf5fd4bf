"""Steps that evaluate, and what is computed from several evaluations on the same frames."""

from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import InputError
from flcav.experiments.federating import round_network
from flcav.experiments.pretraining import WEIGHTS
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.files import atomic_path
from flcav.perception.metrics import Matches, average_precision, bootstrap_difference
from flcav.perception.objects.evaluate import Evaluation, evaluate, number_or_none
from flcav.perception.objects.weights import load_network
from flcav.seeds import stream

MATCHES = "matches.npz"


def test_arm(work: Work, arm: str, town: str) -> dict[str, Any]:
    """Evaluate an arm's final weights on a town's test frames."""
    data = opened(work, f"{town}-test")
    network = load_network(work.inputs[arm] / WEIGHTS)
    frames = (data.frame(i) for i in range(len(data)))
    result = evaluate(network, frames, total=len(data), progress=work.report)
    _save_matches(work.folder / MATCHES, result)
    if not result.targets["Car"]:
        raise InputError(f"{town}: its {result.frames} test frames hold no car to find; take more scenes")
    half, strict, bev = result.score("Car"), result.score("Car", "3d", 0.7), result.score("Car", "bev", 0.5)
    return {
        "ap50": half.ap,
        "ap50_low": number_or_none(half.low),
        "ap50_high": number_or_none(half.high),
        "ap70": strict.ap,
        "ap70_low": number_or_none(strict.low),
        "ap70_high": number_or_none(strict.high),
        "bev50": bev.ap,
        "aos50": half.aos,
        "right_headings": None if np.isnan(half.right) else half.right,
        "frames": result.frames,
        "scenes": len(set(result.scenes)),
        "targets": result.targets["Car"],
        "hidden": result.hidden["Car"],
    }


def test_rounds(work: Work, arm: str, town: str, frames: int) -> list[dict[str, Any]]:
    """Evaluate an arm's weights after each of its rounds on the first `frames` test frames of a town."""
    data = opened(work, f"{town}-test")
    chosen = np.linspace(0, len(data) - 1, min(frames, len(data))).astype(int)
    network = load_network(work.inputs[arm] / WEIGHTS)
    rows = []
    rounds = int(work.result(arm)["rounds"])
    for round_ in range(1, rounds + 1):
        at_round = round_network(network, work.inputs[arm], round_)
        result = evaluate(at_round, (data.frame(int(i)) for i in chosen))
        rows.append({"round": round_, "ap50": result.score("Car", "3d", 0.5).ap, "frames": len(chosen)})
        work.report(round_, rounds, "")
    return rows


def difference(before: Path, after: Path, seed: int) -> dict[str, float]:
    """Return AP50 of `after` minus `before` (folders of two test steps on the same frames) and its 95 % interval."""
    (first, scenes), (second, _) = _load_matches(before / MATCHES), _load_matches(after / MATCHES)
    low, high = bootstrap_difference(first, second, scenes, rng=stream(seed, "bootstrap"))
    return {"mean": average_precision(second) - average_precision(first), "low": low, "high": high}


def _save_matches(path: Path, result: Evaluation) -> None:
    matches = result.score("Car", "3d", 0.5).matches
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, scenes=np.array(result.scenes), **vars(matches))


def _load_matches(path: Path) -> tuple[Matches, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        fields = {name: arrays[name] for name in Matches.__dataclass_fields__}
        return Matches(**fields), arrays["scenes"]
