"""Points of the roads of an OpenDRIVE map by ASAM's quality checker.

Argument: a map. Answer: rows of road, s, t, x, y, z; t is measured along the tilted cross-section.
"""

import json
import sys

from lxml import etree
from qc_opendrive.base.utils import get_point_xyz_from_road

rows = []
for road in etree.parse(sys.argv[1]).getroot().iterfind("road"):
    length = float(road.get("length"))
    for i in range(15):
        for t in (-9.0, -2.0, 0.0, 3.0, 8.0):
            point = get_point_xyz_from_road(road, i * length / 14.5, t, 0.0)
            if point is not None:
                rows.append((road.get("id"), i * length / 14.5, t, float(point.x), float(point.y), float(point.z)))
print(json.dumps(rows))
