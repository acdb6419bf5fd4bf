"""The navigation mesh of a town: its triangles cover the footpaths, and its bytes are as Detour's headers have them."""

import struct

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon, box

from flcav.carla.frames import MapFrame
from flcav.carla.server.maps import (
    Area,
    build_navigation_mesh,
    find_neighbours,
    list_footpaths,
    pack_mesh,
    triangulate,
)
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.town import load_town


@pytest.mark.parametrize("name", ["grid", "ring", "suburb", "arterial"])
def test_triangles_cover_the_footpaths_and_lead_everywhere(name: str) -> None:
    walked, crossed = list_footpaths(read_net(load_town(name).net))
    corners, triangles, areas = triangulate(walked, crossed)
    parts = [Polygon(corners[row]) for row in triangles]
    for area, wanted in ((Area.SIDEWALK, walked), (Area.CROSSING, crossed)):
        covered = shapely.union_all([part for part, own in zip(parts, areas, strict=True) if own == area])
        assert covered.symmetric_difference(wanted).area < 0.002 * wanted.area
    assert all(part.exterior.is_ccw for part in parts)
    beyond, reached, open_ = find_neighbours(triangles), {0}, [0]
    while open_:
        for row in (int(each) - 1 for each in beyond[open_.pop()] if each):
            if row not in reached:
                reached.add(row)
                open_.append(row)
    assert len(reached) == len(triangles)


def test_neighbours_share_an_edge_from_both_sides() -> None:
    _, triangles, areas = triangulate(box(0, 0, 4, 2), box(4, 0, 6, 2))
    beyond = find_neighbours(triangles)
    assert areas.tolist().count(Area.CROSSING) == 2
    for row, own in enumerate(beyond.tolist()):
        for edge, other in enumerate(own):
            pair = {int(triangles[row, edge]), int(triangles[row, (edge + 1) % 3])}
            assert not other or (pair <= {*triangles[other - 1].tolist()} and row + 1 in beyond[other - 1])
    assert np.count_nonzero(beyond) == 2 * (len(triangles) - 1)  # a strip


def test_the_file_has_the_sizes_that_its_headers_say() -> None:
    points = np.array(((0.0, 0.0, 0.1), (0.0, 2.0, 0.2), (4.0, 0.0, 0.3)))
    data = pack_mesh(points, np.array(((0, 1, 2),)), np.array((int(Area.CROSSING),)))
    magic, version, tiles, *_, reference, size = struct.unpack_from("<3i3f2f2iIi", data)
    assert (magic.to_bytes(4, "big"), version, tiles, reference, size) == (b"MSET", 1, 1, 2, len(data) - 48)
    head = struct.unpack_from("<5iI9i10f", data, 48)
    assert head[0].to_bytes(4, "big") == b"DNAV"
    polygons, corners, links, details, extra, faces, tree, others, _ = head[6:15]
    assert size == 100 + 12 * corners + 32 * polygons + 12 * links + 12 * details + 12 * extra + 4 * faces
    assert (polygons, corners, details, faces, tree, others) == (1, 3, 1, 1, 0, 0)
    np.testing.assert_allclose(head[18:24], (0, 0.1, 0, 4, 0.3, 2), atol=1e-6)
    assert struct.unpack_from("<9f", data, 148) == pytest.approx((0, 0.1, 0, 0, 0.2, 2, 4, 0.3, 0))  # y is up
    assert struct.unpack_from("<I6H6HHBB", data, 184) == (0, 0, 1, 2, *[0] * 9, 1 << Area.CROSSING, 3, Area.CROSSING)


def test_a_town_without_footpaths_has_none() -> None:
    bare = RoadNet({}, {}, frozenset(), {}, ())
    assert build_navigation_mesh(bare, load_town("grid"), MapFrame()) == b""
