"""Drawn streets: what they consist of, that a seed repeats them, and that a dataset keeps them."""

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon

from flcav.config import InputError
from flcav.geometry import inverse
from flcav.perception.task import KnownLidar
from flcav.perception.weights import find_recorded_lidar
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.randomisation import (
    DRAWN_BEAMS,
    FACTORS,
    draw_terrain,
    randomise_bodies,
    randomise_rig,
    randomise_town,
    town_files,
)
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream
from flcav.world.map.parameters import BOUNDARIES
from flcav.world.map.relief import Relief
from flcav.world.map.street_furniture import outline_space
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import Town, load_town
from flcav.world.shapes import SHAPES

FIELDS = {"town": "suburb", "seed": 3, "cavs": 2, "warmup_s": 35.0, "spins_per_scene": 1, "vehicle_rig": "kitti_lidar"}


@pytest.fixture(scope="module")
def source() -> EmbeddedSource:
    return EmbeddedSource(Recipe.model_validate(FIELDS | {"randomise": "streets"}))


def footprints(town: Town, kinds: tuple[str, ...]) -> list[Polygon]:
    return [make_footprint(*row[:5]) for kind, rows in town.clutter if kind in kinds for row in rows.tolist()]


def test_plots_are_enclosed_beside_roads_and_houses(source: EmbeddedSource):
    authored = load_town("suburb")
    assert not footprints(authored, ("wall", "fence", "hedgerow", "railing"))
    pieces = footprints(source.town, BOUNDARIES)
    assert len(pieces) > 50
    closed = shapely.union_all([Polygon(outline) for outline in source.town.roads])
    houses = [make_footprint(*row[:5]) for row in source.town.buildings.tolist()]
    assert not shapely.intersects(pieces, closed).any()
    assert not shapely.STRtree(houses).query(pieces, predicate="intersects").size


def test_small_objects_stand_at_the_kerb(source: EmbeddedSource):
    pieces = footprints(source.town, ("bollard", "post"))
    kerbs = shapely.union_all([shapely.LineString(line) for line in source.town.kerbs])
    away = shapely.distance([piece.centroid for piece in pieces], kerbs)
    assert (away < 0.6).mean() > 0.3  # others are drawn as clutter behind the sidewalk


def test_terrain_is_no_steeper_than_its_waves(source: EmbeddedSource):
    town = load_town("suburb")
    relief = draw_terrain(town, stream(5, "terrain"))
    corners = relief.points[relief.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slope = np.hypot(normal[:, 0], normal[:, 1]) / np.abs(normal[:, 2])
    middle = corners[:, :, :2].mean(axis=1)
    on_road = shapely.contains_xy(shapely.union_all([Polygon(outline) for outline in town.roads]), *middle.T)
    assert np.ptp(relief.points[:, 2]) > 0.5
    assert 0.005 < np.median(slope[on_road]) < 3 * 0.035 + 3 * 2 * np.pi * 0.08 / 15
    assert slope[on_road].max() < 0.25


def test_a_folder_of_its_files_is_the_drawn_town(source: EmbeddedSource, tmp_path):
    folder = tmp_path / source.town.name
    folder.mkdir()
    for name, data in source.town_files().items():
        (folder / name).write_bytes(data)
    found = load_town(folder)
    assert found.parameters == source.town.parameters
    assert [kind for kind, _ in found.clutter] == [kind for kind, _ in source.town.clutter]
    for own, drawn in zip(found.clutter, source.town.clutter):
        np.testing.assert_array_equal(own[1], drawn[1])
    assert isinstance(found.relief, Relief)
    assert source.town.relief is not None
    np.testing.assert_array_equal(found.relief.points, source.town.relief.points)


def test_a_seed_repeats_the_streets_and_another_draws_another_lidar(source: EmbeddedSource):
    again = randomise_town(load_town("suburb"), stream(3, "streets", "suburb"))
    assert town_files(again) == source.town_files()
    assert randomise_rig(RIGS["kitti_lidar"], stream(3, "rig")) != randomise_rig(RIGS["kitti_lidar"], stream(4, "rig"))


def test_every_car_has_a_lidar_of_its_own(source: EmbeddedSource):
    first, second = (rig.lidars["velodyne"] for rig in source.vehicle_rigs)
    assert first.mount != second.mount
    assert first.settings.elevations_deg != second.settings.elevations_deg
    nominal = RIGS["kitti_lidar"]
    drawn = [randomise_rig(nominal, stream(seed, "rig")).lidars["velodyne"] for seed in range(40)]
    heights = np.array([lidar.mount.z for lidar in drawn])
    assert 1.53 <= heights.min() < 1.6
    assert 2.05 < heights.max() <= 2.13
    assert {lidar.settings.range_m for lidar in drawn} == {120.0}
    assert len({lidar.settings.channels for lidar in drawn}) > 8  # even patterns differ in it
    assert find_recorded_lidar(source.describe()) == KnownLidar(DRAWN_BEAMS["streets"], 120)
    beams = [lidar.settings.channels for lidar in drawn]
    assert min(beams) >= DRAWN_BEAMS["streets"][0]
    assert max(beams) == DRAWN_BEAMS["streets"][1]


def test_lidars_on_the_market_are_drawn_with_beams_that_fail():
    nominal = RIGS["kitti_lidar"]
    drawn = [randomise_rig(nominal, stream(seed, "rig"), "wide").lidars["velodyne"] for seed in range(200)]
    heights = np.array([lidar.mount.z for lidar in drawn])
    assert 1.2 <= heights.min() < 1.25
    assert 2.25 < heights.max() <= 2.3
    beams = np.array([lidar.settings.channels for lidar in drawn])
    whole = np.isin(beams, [len(known.elevations_deg) for known in BEAMS.values()])
    assert 0.1 < (~whole).mean() < 0.4
    assert 8 <= beams.min() < 16
    assert beams.max() == DRAWN_BEAMS["wide"][1] == 128
    assert 0.1 < (beams <= 16).mean() < 0.25  # a VLP-16 in three of 23 patterns
    known = {known.azimuth_steps for known in BEAMS.values()}
    steps = {lidar.settings.azimuth_steps for lidar in drawn if lidar.settings.channels == 16}
    assert steps <= known | {step // 2 for step in known}
    assert any(step not in known for step in steps)


def test_sizes_are_drawn_by_category_and_the_ends_of_cars_are_bowed(source: EmbeddedSource):
    trace = source.trace(source.scenes()[0])
    nominal = np.array([SHAPES[kind][shape][1:] for kind, shape in zip(trace.category, trace.shape)])
    for kind, spans in FACTORS.items():
        low, high = np.transpose(spans)
        factor = (trace.size / nominal)[trace.category == kind]
        assert (factor >= low - 0.002).all()
        assert (factor <= high + 0.002).all()
        assert len(factor) < 3 or (np.std(factor, axis=0) > (high - low) / 10).all()
    others = ~np.isin(trace.category, [*FACTORS])
    np.testing.assert_array_equal(trace.size[others], nominal[others])
    cars = np.isin(trace.category, ("car", "van"))
    assert trace.bow is not None
    assert (trace.bow[~cars] == 0).all()
    assert 0.1 <= trace.bow[cars].min() < trace.bow[cars].max() <= 0.5
    again = randomise_bodies(trace, stream(0, "sizes"))
    assert again.model(0)[:2] == trace.model(0)[:2]


@pytest.mark.slow
def test_returns_of_a_resized_car_lie_in_its_box(source: EmbeddedSource):
    frame = next(source.frames(source.scenes()[0]))
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor("velodyne")))
    near = frame.annotations.returns.argmax()
    points = frame.lidar["velodyne"][:, :3] - boxes.center[near]
    cos, sin = np.cos(boxes.yaw[near]), np.sin(boxes.yaw[near])
    along, aside = points[:, 0] * cos + points[:, 1] * sin, points[:, 1] * cos - points[:, 0] * sin
    inside = (np.abs(along) < boxes.size[near, 0] / 2 + 0.15) & (np.abs(aside) < boxes.size[near, 1] / 2 + 0.15)
    high = points[inside, 2] > 0.3 - boxes.size[near, 2] / 2  # above the ground, which is uneven
    assert abs(high.sum() / frame.annotations.returns[near] - 1) < 0.15


def test_a_lidar_that_is_drawn_into_the_ground_is_refused():
    rig = {"lidars": {"low": {"mount": {"z": 0.05}}}}
    with pytest.raises(InputError, match="not above the ground"):
        EmbeddedSource(Recipe.model_validate(FIELDS | {"randomise": "streets", "vehicle_rig": rig, "cavs": 9}))


def test_without_the_field_nothing_is_drawn():
    source = EmbeddedSource(Recipe.model_validate(FIELDS))
    assert "randomise" not in source.describe()
    assert source.town is load_town("suburb")
    assert source.vehicle_rigs == [source.recipe.vehicle_rig] * 2
    assert not source.town_files()


def test_bays_lie_behind_the_sidewalks_in_rows_and_apart():
    town = load_town("suburb")
    drawn = randomise_town(town, stream(3, "streets", "suburb"), "wide")
    bays = [outline_space(space) for space in drawn.parameters.parking]
    assert len(bays) > 20
    closed = shapely.union_all([Polygon(outline) for outline in (*town.roads, *town.sidewalks)])
    assert not shapely.intersects(bays, closed).any()
    assert shapely.union_all(bays).area == pytest.approx(sum(bay.area for bay in bays), rel=0.02)
    near = shapely.distance(bays, closed)
    assert (near < 0.7).mean() > 0.9
    houses = [make_footprint(*row[:5]) for row in drawn.buildings.tolist()]
    assert not shapely.STRtree(houses).query(bays, predicate="intersects").size
    assert not randomise_town(town, stream(3, "streets", "suburb")).parameters.parking
    towns = [randomise_town(town, stream(seed, "streets"), "wide").parameters for seed in range(2)]
    assert {street.parked == 0 for streets in towns for street in streets.streets.values()} == {True, False}
