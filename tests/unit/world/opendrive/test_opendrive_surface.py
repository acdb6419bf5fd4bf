"""Reference lines and surfaces of OpenDRIVE roads, their relief, and what stands and drives on it."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import LinearNDInterpolator
from shapely import box, contains_xy, union_all
from shapely.geometry import Point, Polygon

from flcav.geometry import Boxes, angles_of, inverse, points_in_boxes, pose, rotations
from flcav.world.map.relief import Deck, Relief, find_tilts
from flcav.world.materials import Material
from flcav.world.meshes.mesh import FLAT_M, _cut, drape_area, drape_polygon, drape_wall
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.reference_line import ReferenceLine
from flcav.world.opendrive.road_surface import Road
from flcav.world.traffic.traffic import stand_on_relief

POINTS = np.random.default_rng(0).uniform((-50, -40, 0), (50, 40, 6), (200, 3))


def road(shape: str, length: float, inside: str = "") -> ElementTree.Element:
    return ElementTree.fromstring(
        f'<road id="1" length="{length}"><planView><geometry s="0" x="3" y="-2" hdg="0.7" length="{length}">'
        f"{shape}</geometry></planView>{inside}</road>"
    )


@pytest.mark.parametrize(
    ("shape", "turn"),
    [
        ("<line/>", lambda s: 0.0),
        ('<arc curvature="-0.02"/>', lambda s: -0.02 * s),
        ('<spiral curvStart="0.01" curvEnd="-0.08"/>', lambda s: 0.01 * s - 0.09 / 120 * s**2),
    ],
)
def test_a_reference_line_is_the_integral_of_its_direction(shape: str, turn) -> None:
    for s in (0.0, 17.0, 60.0):
        x, y, heading = ReferenceLine(road(shape, 60.0)).at(np.array([s]))[0]
        assert heading == pytest.approx(0.7 + turn(s))
        assert x == pytest.approx(3 + quad(lambda at: np.cos(0.7 + turn(at)), 0, s)[0], abs=1e-9)
        assert y == pytest.approx(-2 + quad(lambda at: np.sin(0.7 + turn(at)), 0, s)[0], abs=1e-9)


def test_cubics_go_where_their_polynomials_say() -> None:
    line = ReferenceLine(road('<paramPoly3 aU="0" bU="40" cU="1" dU="0" aV="0" bV="0" cV="6" dV="-2"/>', 40.0))
    cos, sin = np.cos(0.7), np.sin(0.7)
    u, v = 40 * 0.5 + 0.25, 6 * 0.25 - 2 * 0.125
    assert line.at(np.array([20.0]))[0, :2] == pytest.approx((3 + cos * u - sin * v, -2 + sin * u + cos * v))
    poly = ReferenceLine(road('<poly3 a="0" b="0" c="0.01" d="0"/>', 30.0))
    along = quad(lambda u: np.hypot(1, 0.02 * u), 0, 20.0)[0]  # at u = 20
    assert poly.at(np.array([along]))[0, :2] == pytest.approx(
        (3 + cos * 20 - sin * 4, -2 + sin * 20 + cos * 4), abs=2e-3
    )


LANES = (
    '<lanes><laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneSection s="0"><left><lane id="1" type="driving">'
    '<width sOffset="0" a="3" b="0.1" c="0" d="0"/></lane></left><center><lane id="0"/></center><right>'
    '<lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></right></laneSection></lanes>'
)
PROFILE = (
    '<elevationProfile><elevation s="0" a="2" b="0.1" c="0" d="0"/><elevation s="20" a="4" b="0" c="0.01" d="0"/>'
    '</elevationProfile><lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/>'
    '<shape s="0" t="-5" a="0" b="0.02" c="0" d="0"/><shape s="0" t="0" a="0.1" b="-0.02" c="0" d="0"/>'
    '<shape s="40" t="-5" a="0" b="0" c="0" d="0"/>'
    '<crossfall side="right" s="0" a="0.03" b="0" c="0" d="0"/></lateralProfile>'
)


def test_a_surface_adds_its_profiles() -> None:
    one = Road(road("<line/>", 40.0, PROFILE + LANES))
    left, right = one.height(np.array([10.0, 30.0]), np.array([2.0, -3.0]))
    assert left == pytest.approx(2 + 1 + 2 * np.tan(0.1) + 0.75 * (0.1 - 0.04))  # the shape fades out towards s = 40
    assert right == pytest.approx(4 + 1 - 3 * np.tan(0.1) - 3 * np.tan(0.03) + 0.25 * 0.04)
    assert one.borders(10.0) == pytest.approx({0: 0.5, 1: 4.5, -1: -3.5})
    assert one.lane_centre(10.0, -1) == pytest.approx(-1.5)
    assert not one.is_level
    assert Road(road("<line/>", 40.0, LANES)).is_level


def test_the_terrain_of_a_road_is_its_surface() -> None:
    root = ElementTree.Element("OpenDRIVE")
    root.append(road("<line/>", 40.0, PROFILE.replace("crossfall", "crossslope") + LANES))
    relief = Relief(sample_heights(root, Path("map")).points)
    surface = Road(root[0])
    s, t = np.array([4.0, 14.0, 26.0]), np.array([2.0, 0.0, -1.0])
    x, y, z = surface.point(s, t).T
    np.testing.assert_allclose(relief.heights(x, y), z, atol=0.02)


def cross(hdg: float = 0.7 + np.pi / 2) -> ElementTree.Element:
    """Return two roads of 120 m that cross at (3, -2): one along 0.7 at height 0, the other 6 m above it at the middle.

    The upper one climbs by 10 % from both ends.
    """
    root = ElementTree.Element("OpenDRIVE")
    climb = (
        '<elevationProfile><elevation s="0" a="0" b="0.1" c="0" d="0"/>'
        '<elevation s="60" a="6" b="-0.1" c="0" d="0"/></elevationProfile>'
    )
    for name, heading, inside in (("1", 0.7, ""), ("2", hdg, climb)):
        row = road("<line/>", 120.0, inside + LANES)
        row.set("id", name)
        row[0][0].attrib |= {
            "x": str(3 - 60 * np.cos(heading)),
            "y": str(-2 - 60 * np.sin(heading)),
            "hdg": str(heading),
        }
        root.append(row)
    return root


def test_a_road_that_passes_over_another_has_a_bridge_there(tmp_path: Path) -> None:
    root = cross()
    found = sample_heights(root, Path("map"))
    relief = Relief(found.points, [Deck(sections) for sections in found.decks])
    relief.save(tmp_path / "heights.parquet")
    again = Relief.load(tmp_path / "heights.parquet")
    (deck,) = again.decks
    assert contains_xy(deck.outline, 3.0, -2.0)
    lower, upper = (Road(row) for row in root)
    s = np.linspace(1.0, 119.0, 237)
    for t in (-3.0, 0.0, 3.0):
        x, y, z = lower.point(s, np.full(len(s), t)).T
        np.testing.assert_allclose(again.heights(x, y), z, atol=0.02)  # no lower where it passes below
        x, y, z = upper.point(s, np.full(len(s), t)).T
        raised = contains_xy(deck.outline, x, y)
        np.testing.assert_allclose(np.where(raised, deck.surface.heights(x, y), again.heights(x, y)), z, atol=0.06)
        assert 15 < raised.sum() / 2 < 40  # [m]


def test_roads_at_almost_one_height_have_no_bridge() -> None:
    level = cross()
    for row in level.iterfind("road/elevationProfile/elevation"):
        row.attrib |= {"a": "2", "b": "0"}
    assert not sample_heights(level, Path("map")).decks


def test_heights_are_linear_over_triangles() -> None:
    relief = Relief(POINTS)
    at = np.random.default_rng(1).uniform((-40, -30), (40, 30), (500, 2))
    np.testing.assert_allclose(relief.heights(*at.T), LinearNDInterpolator(relief._tin, POINTS[:, 2])(at), atol=1e-9)
    assert np.isnan(relief.heights(np.nan, 0.0))
    with pytest.raises(ValueError, match="span no area"):
        Relief(np.c_[np.arange(5.0), np.arange(5.0), np.zeros(5)])


def test_polygons_are_draped_exactly() -> None:
    relief, square = Relief(POINTS), np.array([[-9.0, -8], [12, -8], [12, 11], [-9, 11]])
    mesh = drape_polygon(square, relief, 0.12, Material.ROAD)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    one, other = (corners[:, i, :2] - corners[:, 0, :2] for i in (1, 2))
    area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum() / 2
    assert area == pytest.approx(Polygon(square).area, rel=1e-6)
    middle = corners.mean(axis=1)
    np.testing.assert_allclose(middle[:, 2], relief.heights(*middle[:, :2].T) + 0.12, atol=1e-4)
    wall = drape_wall(np.concatenate((square, square[:1])), relief, (-0.03, 0.12), Material.SIDEWALK)
    above = wall.vertices[:, 2] - relief.heights(*wall.vertices[:, :2].T)
    np.testing.assert_allclose(np.unique(above.round(3)), (-0.03, 0.12))
    foot = wall.vertices[: len(wall.vertices) // 2].astype(np.float64)
    between = foot[:-1] + np.linspace(0, 1, 7)[:, None, None] * (foot[1:] - foot[:-1])
    assert np.abs(between[..., 2] + 0.03 - relief.heights(*between[..., :2].T).T).max() <= FLAT_M + 1e-4


def test_an_area_with_a_hole_is_draped_around_it() -> None:
    area = box(-9, -8, 12, 11).difference(box(-2, -2, 3, 4))
    mesh = drape_area(area, Relief(POINTS), 0.0, Material.GROUND)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    one, other = (corners[:, i, :2] - corners[:, 0, :2] for i in (1, 2))
    assert np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum() / 2 == pytest.approx(area.area, rel=1e-5)
    assert not contains_xy(box(-1.9, -1.9, 2.9, 3.9), *corners.mean(axis=1)[:, :2].T).any()


def test_an_area_of_many_corners_is_cut_as_a_whole_would_be() -> None:
    """Triangles and corners so many that the area is halved several times: each triangle's part is as large."""
    draw = np.random.default_rng(2)
    relief = Relief(np.c_[draw.uniform(-100, 100, (400, 2)), draw.uniform(0, 5, 400)])
    holes = [Point(*at).buffer(2.5) for at in draw.uniform(-90, 90, (60, 2))]
    area = relief.area.difference(union_all(holes))
    triangles = relief.tree.geometries
    parts = _cut(triangles, area)
    assert [part.area for part in parts] == pytest.approx([each.intersection(area).area for each in triangles])
    assert sum(part.area for part in parts) == pytest.approx(area.area)


def slope(ahead: float, left: float) -> Relief:
    """Return the plane that rises by `ahead` a metre of x and `left` a metre of y."""
    corners = np.array([[-100.0, -100], [100, -100], [100, 100], [-100, 100], [3, 5]])
    return Relief(np.c_[corners, corners @ (ahead, left)])


def test_a_body_on_a_slope_lies_in_it() -> None:
    yaw, size = np.array([0.6]), np.array([[4.0, 2.0, 1.5]])
    height, pitch, roll = find_tilts(slope(0.2, -0.1).heights, np.array([5.0]), np.array([1.0]), yaw, size)
    turn = rotations(yaw, pitch, roll)[0]
    normal = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm((0.2, 0.1, 1.0))
    np.testing.assert_allclose(turn[:, 2], normal, atol=2e-3)
    assert height[0] == pytest.approx(0.9)
    assert find_tilts(slope(0.2, 0.0).heights, np.zeros(1), np.zeros(1), np.zeros(1), size)[1][0] == pytest.approx(
        -np.arctan(0.2)
    )


def test_whoever_drives_uphill_climbs() -> None:
    velocity = np.array([[[10.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    found = stand_on_relief(
        slope(0.1, 0.0).heights,
        centre=np.zeros((1, 2, 2)),
        yaw=np.zeros((1, 2)),
        velocity=velocity,
        acceleration=np.array([[[1.0, 0, 0], [0, 0, 0]]]),
        size=np.array([[4.0, 2.0, 1.5], [0.5, 0.5, 1.8]]),
        upright=np.array([False, True]),
    )
    np.testing.assert_allclose(found.velocity[0, :, 2], (1.0, 0.1), atol=1e-6)
    np.testing.assert_allclose(found.acceleration[0, :, 2], (0.1, 0.0), atol=1e-6)
    np.testing.assert_allclose(found.tilt[0], ((-np.arctan(0.1), 0.0), (0.0, 0.0)), atol=1e-9)


def test_angles_and_rotations_are_inverse() -> None:
    angles = np.array([[0.3, -0.2, 0.1], [-2.0, 0.4, -0.3]]).T
    np.testing.assert_allclose(angles_of(rotations(*angles)), angles)
    np.testing.assert_allclose(rotations(*angles)[1], pose(0, 0, 0, *angles[:, 1])[:3, :3])


def test_tilted_boxes_turn_with_their_frame() -> None:
    boxes = replace(Boxes.from_array([[5.0, 1, 2, 4, 2, 1.5, 0.4]], "car"), tilt=np.array([[-0.2, 0.1]]))
    target = pose(1.0, -2.0, 0.5, 1.1, 0.3, -0.2)
    moved = boxes.transform(target)
    expected = boxes.corners()[0] @ target[:3, :3].T + target[:3, 3]
    np.testing.assert_allclose(moved.corners()[0], expected)
    assert points_in_boxes(boxes.corners()[0] * 0.999 + 0.001 * boxes.center, boxes).all()
    assert not points_in_boxes(boxes.corners()[0] + (0, 0, 0.1), boxes, 0.01).all()
    again = moved.transform(inverse(target))
    assert again.tilt is not None
    np.testing.assert_allclose(again.tilt, [[-0.2, 0.1]])
    np.testing.assert_allclose(boxes[[0]].pose(0)[:3, 3], boxes.center[0])
