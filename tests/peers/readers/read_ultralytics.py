"""Ultralytics' check of a dataset, its labels, and an epoch: python read_ultralytics.py EXPORT RUNS [SPLIT].

With a SPLIT, a network that has learnt nothing is tested on it in place of the training.
"""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import torch
from ultralytics import YOLO
from ultralytics.data.dataset import YOLODataset
from ultralytics.data.utils import check_det_dataset
from ultralytics.utils.nms import TorchNMS


def _without_cuda() -> None:
    """Stand in for torchvision, of which `nms` alone is wanted, where it does not load beside torch for CPUs."""
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        sys.modules["torchvision"] = ModuleType("torchvision")
        vars(sys.modules["torchvision"]).update(ops=SimpleNamespace(nms=TorchNMS.nms), __version__="0")


def _labels(about: dict, split: str) -> dict:
    """Return picture -> rows of class and centre, width, height, as Ultralytics has read them."""
    dataset = YOLODataset(img_path=about[split], data=about, task="detect", imgsz=320, augment=False)
    return {
        Path(label["im_file"]).stem: [
            [int(kind), *box] for kind, box in zip(label["cls"].ravel().tolist(), label["bboxes"].tolist())
        ]
        for label in dataset.labels
    }


export, runs = Path(sys.argv[1]), Path(sys.argv[2])
_without_cuda()
torch.set_num_threads(1)
about = check_det_dataset(str(export / "data.yaml"))
read = {"names": about["names"]}
asked = {"data": str(export / "data.yaml"), "imgsz": 320, "batch": 8, "workers": 0, "device": "cpu", "plots": False}
asked |= {"project": str(runs), "exist_ok": True, "verbose": False}
model = YOLO("yolov8n.yaml")
if len(sys.argv) > 3:
    split = sys.argv[3]
    read["labels"] = {split: _labels(about, split)}
    read["measured"] = model.val(split=split, **asked).results_dict
else:
    read["labels"] = {split: _labels(about, split) for split in ("train", "val")}
    read["measured"] = model.train(epochs=1, seed=0, **asked).results_dict
    read["weights"] = Path(model.trainer.last).stat().st_size
print()
print(json.dumps(read, default=float))
