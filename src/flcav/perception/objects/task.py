"""Object detection as a `Task`."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from flcav.config import InputError
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import evaluate
from flcav.perception.objects.infer import box_rows, point_clouds
from flcav.perception.objects.model import NETWORKS, Second
from flcav.perception.objects.samples import Sample, sample_from_frame
from flcav.perception.objects.train import Checkpointing, train
from flcav.perception.objects.weights import load_network, save_network
from flcav.progress import Report, silent
from flcav.seeds import child_seed
from flcav.sensors.frame import Frame

BATCH = 2


class ObjectsTask:
    """3D boxes of road users in a LiDAR sweep."""

    name = "objects"

    def network(self, variant: str = "tiny", seed: int = 0) -> Second:
        """Return a fresh network, `tiny` or `paper`, its weights drawn from `seed`."""
        if variant not in NETWORKS:
            raise InputError(f"network '{variant}': choose one of {', '.join(NETWORKS)}")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(child_seed(seed, "weights"))
            return NETWORKS[variant]()

    def load(self, path: Path) -> Second:
        """Return the network saved at `path`; raises `InputError` where the file is of another one."""
        return load_network(path)

    def save(self, network: Second, path: Path) -> None:
        """Write configuration and weights as safetensors."""
        save_network(network, path)

    def sample(self, frame: Frame, network: Second) -> Sample:
        """Return the frame's sweep with its ground truth as labels."""
        return sample_from_frame(frame, network.config)

    def train(
        self,
        network: Second,
        samples: Sequence[Sample],
        *,
        epochs: int,
        seed: int,
        checkpoint: Path,
        progress: Report = silent,
    ) -> float:
        """Train in place over `epochs` passes, one learning-rate cycle; return the mean loss of the last pass."""
        per_epoch = max(1, len(samples) // BATCH)
        losses = train(
            network,
            samples,
            steps=epochs * per_epoch,
            batch=BATCH,
            seed=seed,
            checkpointing=Checkpointing(checkpoint),
            progress=progress,
        )
        return float(losses[-per_epoch:].mean())

    def evaluate(
        self, network: Second, frames: Iterable[Frame], *, total: int = 0, progress: Report = silent
    ) -> dict[str, Any]:
        """Return AP per class, kind of overlap and IoU, with intervals over scenes."""
        return evaluate(network, frames, total=total, progress=progress).summary()

    def infer(self, network: Second, path: Path, threshold: float = 0.3) -> list[dict[str, Any]]:
        """Return {"path", "boxes": [...]} for each point cloud of `path`, see `infer.point_clouds`."""
        return [
            {"path": str(origin), "boxes": box_rows(detect(network, points, score_threshold=threshold))}
            for origin, points in point_clouds(path)
        ]
