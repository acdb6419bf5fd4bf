"""Lane centres of OpenDRIVE maps by CARLA's own reader, 2 m apart.

Arguments: maps. Answer: by path, rows of road, lane, s, x, y, z, and whether it lies in a junction; y as in the map.
"""

import json
import sys
from pathlib import Path

import carla

out = {}
for path in sys.argv[1:]:
    rows = []
    for point in carla.Map(Path(path).stem, Path(path).read_text()).generate_waypoints(2.0):
        at = point.transform.location
        rows.append((str(point.road_id), point.lane_id, point.s, at.x, -at.y, at.z, point.is_junction))
    out[path] = rows
print(json.dumps(out))
