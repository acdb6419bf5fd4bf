"""Traffic islands, and cutting areas with holes into simple polygons."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, Polygon, box

from flcav.world.map.roads import Edge, Lane, RoadNet
from flcav.world.map.surfaces import build_ground_surfaces, make_footprint, split_into_polygons

holes = st.lists(st.tuples(st.floats(1, 16), st.floats(1, 16), st.floats(0.5, 3), st.floats(0, 3)), max_size=4)


@settings(max_examples=40, deadline=None)
@given(holes)
def test_pieces_cover_the_area_without_holes_or_overlap(cuts: list[tuple[float, float, float, float]]) -> None:
    whole = box(0, 0, 20, 20)
    for x, y, extent, yaw in cuts:
        whole = whole.difference(make_footprint(x, y, yaw, extent, extent / 2))
    pieces = [Polygon(outline) for outline in split_into_polygons(whole)]
    assert all(piece.is_valid and piece.exterior.is_ccw for piece in pieces)
    assert sum(piece.area for piece in pieces) == pytest.approx(whole.area, rel=1e-9)
    assert shapely.union_all(pieces).symmetric_difference(whole).area < 1e-6


def test_parts_stay_apart() -> None:
    pieces = split_into_polygons(MultiPolygon([box(0, 0, 1, 1), box(2, 0, 3, 1)]))
    assert [len(piece) for piece in pieces] == [4, 4]


def test_footprint_is_a_turned_rectangle() -> None:
    turned = make_footprint(1.0, 2.0, np.pi / 2, 4.0, 2.0)
    assert turned.bounds == pytest.approx((0.0, 0.0, 2.0, 4.0))


@pytest.mark.parametrize(("radius_m", "islands"), [(20.0, 1), (60.0, 0)])
def test_a_traffic_island_is_narrow(radius_m: float, islands: int) -> None:
    angle = np.linspace(0.0, 2 * np.pi, 100)
    circle = radius_m * np.column_stack((np.cos(angle), np.sin(angle)))
    edge = Edge("a", "normal", "b", "b", "street", (Lane("a_0", "driving", circle, 4.0, 10.0),))
    ground = build_ground_surfaces(RoadNet({"a": edge}, {}, frozenset(), {}, ()), {})
    assert len(ground.islands.geoms) == islands
    assert ground.sidewalks.area == pytest.approx(islands * np.pi * 18.0**2, rel=0.01)
