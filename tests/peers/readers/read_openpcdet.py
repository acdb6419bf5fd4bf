"""OpenPCDet's KITTI dataset and evaluation on an export: python read_openpcdet.py OPENPCDET EXPORT [DETECTIONS].

DETECTIONS is JSON: frame number -> class -> rows x, y, z, length, width, height, yaw in the LiDAR frame. What OpenPCDet
compiles is restated below in NumPy and shapely; NUMBA_ENABLE_CUDASIM=1 lets its evaluation run without a GPU.
"""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import shapely
import shapely.affinity
import torch
import yaml
from easydict import EasyDict
from restated import VoxelGenerator, module

NUDGE = np.array([0.011, 0.007, 0.005, 0, 0, 0, 0.003])  # its kernel has no room for the corners of two equal boxes
REVERSED = np.array([0, 0, 0, 0, 0, 0, np.pi])


def points_in_boxes_cpu(boxes, points, inside):
    """Set `inside` (N, P) to 1 where a point lies in a box."""
    for i, (x, y, z, *size, yaw) in enumerate(boxes.numpy()):
        away = points.numpy() - (x, y, z)
        local = away @ np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        inside[i] = torch.from_numpy((np.abs(local) <= np.array(size) / 2).all(axis=1))


def boxes_iou_bev_cpu(some, others, iou):
    """Set `iou` (N, M) to that of the boxes seen from above."""
    for i, a in enumerate(map(_outline, some.numpy())):
        for j, b in enumerate(map(_outline, others.numpy())):
            both = a.intersection(b).area
            iou[i, j] = both / (a.area + b.area - both)


def _outline(box):
    x, y, _, length, width, _, yaw = box.tolist()
    outline = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    return shapely.affinity.translate(shapely.affinity.rotate(outline, yaw, (0, 0), use_radians=True), x, y)


def _import_kitti(root: Path) -> ModuleType:
    """Return OpenPCDet's `kitti_dataset`, imported without what is compiled, and without its other datasets."""
    sys.path.insert(0, str(root))
    module("pcdet.version", __version__="0")
    module("pcdet.datasets", __path__=[str(root / "pcdet" / "datasets")])
    module("pcdet.ops.iou3d_nms.iou3d_nms_cuda", boxes_iou_bev_cpu=boxes_iou_bev_cpu)
    module("pcdet.ops.roiaware_pool3d.roiaware_pool3d_cuda", points_in_boxes_cpu=points_in_boxes_cpu)
    module("spconv")
    module("spconv.utils", VoxelGenerator=VoxelGenerator)
    module("torchvision")  # for pictures alone
    module("SharedArray")  # for many processes alone
    from pcdet.datasets.kitti import kitti_dataset

    kitti_dataset.Path = Path  # which it imports as a program only
    return kitti_dataset


def main(root: Path, export: Path, detections: dict) -> dict:
    """Build OpenPCDet's tables; with detections, draw every sample as for training, and evaluate, also reversed."""
    kitti = _import_kitti(root)
    classes = sorted({name for found in detections.values() for name in found})
    config = EasyDict(yaml.safe_load((root / "tools/cfgs/dataset_configs/kitti_dataset.yaml").read_text()))
    config.DATA_AUGMENTOR.AUG_CONFIG_LIST[0].USE_ROAD_PLANE = False  # KITTI's own planes are an extra, too
    kitti.create_kitti_infos(config, classes, export, export, workers=1)
    config.DATA_SPLIT.test, config.INFO_PATH.test = "trainval", ["kitti_infos_trainval.pkl"]
    every = kitti.KittiDataset(config, classes, training=False, root_path=export)
    read = {"frames": {info["point_cloud"]["lidar_idx"]: _frame(info["annos"]) for info in every.kitti_infos}}
    return read | (_train_and_evaluate(kitti, config, every, detections) if detections else {})


def _train_and_evaluate(kitti: ModuleType, config: EasyDict, every, detections: dict) -> dict:
    np.random.seed(0)  # noqa: NPY002 (OpenPCDet draws from it)
    train = kitti.KittiDataset(config, every.class_names, training=True, root_path=every.root_path)
    samples = [train[i] for i in range(len(train))]
    return {
        "boxes": [len(sample["gt_boxes"]) for sample in samples],
        "voxels": list(train.collate_batch(samples)["voxels"].shape),
        "as they are": _evaluate(every, detections, NUDGE),
        "reversed": _evaluate(every, detections, NUDGE + REVERSED),
    }


def _frame(notes: dict) -> dict:
    labelled = int((notes["name"] != "DontCare").sum())
    return {
        "names": notes["name"].tolist(),
        "boxes": notes["gt_boxes_lidar"].tolist(),
        "points": notes["num_points_in_gt"][:labelled].tolist(),
        "truncated": notes["truncated"][:labelled].tolist(),
    }


def _evaluate(dataset, detections: dict, moved: np.ndarray) -> dict:
    found, classes = [], dataset.class_names
    for number in range(len(dataset)):
        item = dataset[number]
        rows = [(box, i) for i, name in enumerate(classes, 1) for box in detections[item["frame_id"]].get(name, [])]
        boxes = (np.array([box for box, _ in rows]).reshape(-1, 7) + moved).astype(np.float32)
        prediction = {
            "pred_boxes": torch.from_numpy(boxes),
            "pred_scores": torch.linspace(0.9, 0.1, len(rows)) - 0.001 * number,
            "pred_labels": torch.tensor([label for _, label in rows], dtype=torch.int64),
        }
        shape = torch.from_numpy(item["image_shape"])[None]
        batch = {"frame_id": [item["frame_id"]], "calib": [item["calib"]], "image_shape": shape}
        found += dataset.generate_prediction_dicts(batch, [prediction], np.array(classes))
    _, measured = dataset.evaluation(found, classes)
    return {name: float(value) for name, value in measured.items()}


if __name__ == "__main__":
    given = json.loads(Path(sys.argv[3]).read_text()) if len(sys.argv) > 3 else {}
    print()
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]), given)))
