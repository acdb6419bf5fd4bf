"""Say why labels by tracks miss objects: `python tools/explain_labels.py RUN...`, folders of runs (`flcav run --out`).

The objects are the targets of the frames that vehicles learn from in stage II: in range, with five LiDAR returns or
more. One is labelled where a track matches it at an IoU of 0.5 in 3D with the run's threshold or a higher score.
"""

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import asked_of
from flcav.perception.ops.boxes import iou
from flcav.runs.frames import Frames
from flcav.runs.labels.quality import RETURNS
from flcav.runs.labels.tracks import load_tracks
from flcav.runs.results.training import Pretrained
from flcav.runs.stages.regions import load_stage_network
from flcav.storage.markdown import format_table

OVERLAP, TOUCH = 0.5, 0.1  # IoU in 3D of a right label, and of a track that has to do with an object
KINDS = tuple(f"from {each} returns" for each in RETURNS)
LABELLED, FAINT, MISPLACED, NO_TRACK = "labelled", "score below the threshold", "box off", "no track"


def explain(tracks: Boxes, targets: Boxes, threshold: float) -> list[str]:
    """Return what stands against a label of each target, or that it has one."""
    kept = np.asarray(tracks.score) >= threshold
    labelled = set(assign_targets(tracks[kept], targets, OVERLAP).tolist())
    share = iou(torch.from_numpy(tracks.array()), torch.from_numpy(targets.array()), "3d").numpy()
    reasons = []
    for row in range(len(targets)):
        if row in labelled:
            reasons.append(LABELLED)
        elif (share[:, row] >= OVERLAP).any():
            reasons.append(FAINT)
        else:
            reasons.append(MISPLACED if (share[:, row] >= TOUCH).any() else NO_TRACK)
    return reasons


def explain_region(
    folder: Path, region: str, config: SecondConfig, threshold: float
) -> tuple[list[str], NDArray[np.int64]]:
    """Return what stands against a label of each target of a region's frames, and the targets' returns (T,)."""
    split, reasons, returns = Frames.open(folder / f"{region}-edge-objects"), list[str](), [np.zeros(0, np.int64)]
    for i, tracks in load_tracks(folder / f"{region}-tracks-objects").items():
        truth = asked_of(split.data.frame(i), config)
        assert truth.returns is not None  # of annotated frames
        reasons += explain(tracks, truth.targets, threshold)
        returns.append(truth.returns)
    return reasons, np.concatenate(returns)


def main() -> None:
    """Print the shares by region and by the number of LiDAR returns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    counts: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    for run in parser.parse_args().runs:
        work = run / "work"
        threshold = Pretrained.load(work / "pretrain-objects").track_threshold or 0.0
        config = load_stage_network(OBJECTS, work / "pretrain-objects").config
        for folder in sorted(work.glob("*-tracks-objects")):
            region = folder.name.removesuffix("-tracks-objects")
            reasons, returns = explain_region(work, region, config, threshold)
            kind = np.searchsorted(RETURNS, returns, side="right") - 1
            for reason, number in zip(reasons, kind.tolist(), strict=True):
                counts[region][KINDS[number]][reason] += 1
                counts[region]["all"][reason] += 1
    columns = LABELLED, FAINT, MISPLACED, NO_TRACK
    rows = []
    for region, kinds in counts.items():
        for kind in ("all", *KINDS):
            own = kinds[kind]
            rows.append([region, kind, own.total(), *(f"{own[each] / max(own.total(), 1):.2f}" for each in columns)])
    print(format_table(("region", "objects", "number", *columns), rows))


if __name__ == "__main__":
    main()
