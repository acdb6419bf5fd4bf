"""pycocotools on an export: python read_pycocotools.py EXPORT LABELS.

It prints the masks' areas and bounding boxes as decoded, and COCO's measures of the labels as detections.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from pycocotools.mask import area, toBbox


def _check(coco: COCO, folder: Path) -> list:
    rows = []
    for note in coco.loadAnns(coco.getAnnIds()):
        image = coco.loadImgs([note["image_id"]])[0]
        with Image.open(folder / image["file_name"]) as picture:
            assert picture.size == (image["width"], image["height"])
        row = {"image": Path(image["file_name"]).stem, "name": coco.loadCats([note["category_id"]])[0]["name"]}
        row |= {"bbox": note["bbox"], "said": note["area"]}
        encoded = coco.annToRLE(note)
        assert encoded is note["segmentation"], "pycocotools takes the mask as it is"
        row |= {"area": int(area(encoded)), "mask_bbox": toBbox(encoded).tolist(), "track": note.get("track")}
        row["sum"] = int(coco.annToMask(note).sum())
        rows.append(row)
    return rows


def _evaluate(coco: COCO, kind: str) -> float:
    field = {"bbox": "bbox", "segm": "segmentation"}[kind]
    found = [
        {name: note[name] for name in ("image_id", "category_id", field)} | {"score": 0.5 + 0.4 / (1 + note["id"])}
        for note in coco.loadAnns(coco.getAnnIds())
    ]
    evaluation = COCOeval(coco, coco.loadRes(found), kind)
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    return float(evaluation.stats[0])


export, labels = Path(sys.argv[1]), sys.argv[2]
read = {}
for split in ("train", "val"):
    coco = COCO(str(export / "annotations" / f"{labels}_{split}.json"))
    read[split] = {"rows": _check(coco, export / "images" / split)}
    read[split]["ap"] = {kind: _evaluate(coco, kind) for kind in ("bbox", "segm")}
    assert np.isfinite(list(read[split]["ap"].values())).all()
print()
print(json.dumps(read))
