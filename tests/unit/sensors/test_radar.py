from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flcav.geometry import pose
from flcav.sensors.radar import (
    ACTOR_RCS,
    Cells,
    Radar,
    compute_actor_rcs,
    cross_sections,
    detect_cells,
    draw_rays,
    false_alarms,
    silhouette,
    snr_per_m2,
    sweep_radar,
)
from flcav.world.map.town import Town
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene
from flcav.world.trace import CATEGORIES, Trace
from flcav.world.weather import WEATHERS

AT = pose(0.0, 0.0, 0.7)
QUIET: dict[str, Any] = {"false_alarm_rate": 1e-12}
WALL = np.array([[60.0, 0.0, 0.0, 10.0, 200.0, 30.0]])


@pytest.fixture
def world(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Callable[..., Scene]:
    def build(*actors: tuple[str, str, float, float, float], **town: Any) -> Scene:
        return Scene(small_town(**town), standing([(name, kind, 0, x, y, yaw) for name, kind, x, y, yaw in actors]))

    return build


def sweep(scene: Scene, seed: int = 0, velocity: tuple[float, ...] = (0.0, 0.0, 0.0), **settings: Any):
    options = {name: settings.pop(name) for name in ("hidden", "weather") if name in settings}
    rng = np.random.default_rng(seed)
    return sweep_radar(scene, settings.pop("at", AT), np.array(velocity), Radar(**settings), rng, **options)


def test_a_car_is_where_it_is_and_as_fast_as_it_is(world: Callable[..., Scene]):
    scene = world(("veh0", "car", 30.0, 8.0, 0.0))
    scene.trace.velocity[0, 0] = (20.0, 0.0, 0.0)
    found = [sweep(scene, seed, velocity=(12.0, 0.0, 0.0)) for seed in range(20)]
    points = np.concatenate([points[actor == 0] for points, actor in found])
    assert len(points) > 60
    x, y = points[:, 0] * np.cos(points[:, 1]), points[:, 0] * np.sin(points[:, 1])
    assert (np.abs(x - 30.0) < 3.2).mean() > 0.95
    assert (np.abs(y - 8.0) < 2.0).mean() > 0.95
    expected = 8.0 * np.cos(np.arctan2(8.0, 30.0))  # relative speed, along the line of sight
    assert np.median(points[:, 3]) == pytest.approx(expected, abs=0.1)
    town = np.concatenate([points[actor < 0] for points, actor in found])
    assert np.median(town[:, 3] + 12.0 * np.cos(town[:, 1]) * np.cos(town[:, 2])) == pytest.approx(0.0, abs=0.1)


def test_an_approaching_actor_has_a_negative_doppler_and_a_turning_one_a_spread(world: Callable[..., Scene]):
    scene = world(("veh0", "truck", 20.0, 0.0, np.pi / 2))
    scene.trace.velocity[0, 0], scene.trace.yaw_rate[0, 0] = (-5.0, 0.0, 0.0), 0.8
    points = np.concatenate([sweep(scene, seed, **QUIET)[0] for seed in range(10)])
    points = points[np.abs(points[:, 3]) > 1]
    aside = points[:, 0] * np.sin(points[:, 1])
    slope, middle = np.polyfit(aside, points[:, 3], 1)
    assert middle == pytest.approx(-5.0, abs=0.3)
    assert slope == pytest.approx(-0.8, abs=0.15)  # its front, to the left, turns towards us


def test_the_carrier_is_not_seen_and_the_stream_decides(world: Callable[..., Scene]):
    scene = world(("cav0", "car", 0.0, 0.0, 0.0), ("veh1", "car", 25.0, 0.0, 0.0))
    assert 0 not in sweep(scene, hidden=0, at=pose(0, 0, 0.7))[1]
    first, again, other = (sweep(scene, seed, hidden=0)[0].tobytes() for seed in (1, 1, 2))
    assert first == again != other
    points, _ = sweep(scene, hidden=0)
    assert points.dtype == np.float32
    assert (np.diff(points[:, 0]) >= 0).all()
    radar = Radar()
    low, high = radar.extent().T
    assert ((points[:, :4] >= low - 1e-4) & (points[:, :4] <= high + 1e-4)).all()


def cells(count: int, range_m: float, sigma: float) -> Cells:
    values = np.tile((range_m, 0.0, 0.0, 0.0), (count, 1))
    return Cells(values, np.full(count, sigma), np.zeros(count, np.int64))


@pytest.mark.parametrize(("range_m", "sigma"), [(150.0, 10.0), (75.0, 10.0), (60.0, 0.1), (119.0, 30.0), (140.0, 1.0)])
def test_detection_follows_swerling_and_the_radar_equation(range_m: float, sigma: float):
    radar = Radar(range_m=200.0, detects_car_m=150.0, false_alarm_rate=1e-5)
    half = -np.log(1e-5) / np.log(2) - 1
    snr = half * sigma / 10.0 * (150.0 / range_m) ** 4
    reported, _ = detect_cells(cells(20_000, range_m, sigma), radar, 0.0, np.random.default_rng(0))
    assert len(reported) / 20_000 == pytest.approx(1e-5 ** (1 / (1 + snr)), abs=0.012)


def test_errors_shrink_with_power_and_cross_sections_are_right_on_average():
    radar = Radar(range_m=200.0, false_alarm_rate=1e-5)
    spread = []
    for range_m in (20.0, 120.0):
        reported, _ = detect_cells(cells(20_000, range_m, 10.0), radar, 0.0, np.random.default_rng(0))
        spread.append(reported[:, 0].std() / radar.range_cell_m)
        if range_m == 20.0:
            assert np.mean(10 ** (reported[:, 4] / 10)) == pytest.approx(10.0, rel=0.03)
            assert len(reported) > 19_800
    assert spread[0] < 0.1 * spread[1] < 0.02


def test_rain_weakens_by_its_decibels_per_kilometre():
    radar, at = Radar(), np.array([[100.0, 0.0, 0.0, 0.0]])
    dry, wet = (snr_per_m2(radar, at, rain)[0] for rain in (0.0, 25.0))
    assert 10 * np.log10(dry / wet) == pytest.approx(0.2 * 1.13 * 25**0.718)
    edge = np.array([[100.0, np.radians(60.0), 0.0, 0.0]])
    assert 10 * np.log10(dry / snr_per_m2(radar, edge, 0.0)[0]) == pytest.approx(6.0)


def test_heavy_rain_costs_far_detections(world: Callable[..., Scene]):
    scene = world(*((f"veh{i}", "car", 80.0 + 5 * i, 10.0 * i - 30, 0.3 * i) for i in range(7)))
    counts = [
        sum(np.count_nonzero(sweep(scene, seed, weather=weather)[1] >= 0) for seed in range(15))
        for weather in (WEATHERS["clear"], WEATHERS["fog"], WEATHERS["heavy_rain"])
    ]
    assert counts[0] == counts[1] > 1.05 * counts[2] > 0


def test_false_alarms_come_at_the_rate_asked_for():
    radar = Radar(false_alarm_rate=1e-6)
    number = [len(false_alarms(radar, 0.0, np.random.default_rng(seed))) for seed in range(300)]
    low, high = radar.extent().T
    assert np.mean(number) == pytest.approx(1e-6 * np.prod((high - low) / radar.resolution()), rel=0.05)
    assert np.var(number) == pytest.approx(np.mean(number), rel=0.3)


def total(scene: Scene, actor: int = 0) -> float:
    """Return the mean cross-section [m^2] of all patches of an actor that rays meet, over many sweeps."""
    radar, sums = Radar(azimuth_cell_deg=1.0, elevation_cell_deg=1.0), []
    for seed in range(8):
        directions, solid_angle = draw_rays(radar, np.random.default_rng(seed))
        hits = scene.cast(AT, directions, far_m=100.0)
        met = np.flatnonzero(hits.instance == actor + 1)
        part = Hits(hits.distance[met], hits.instance[met], hits.face[met])
        sums.append(cross_sections(scene, AT, directions[met].astype(float), part, solid_angle[met]).sum())
    return float(np.mean(sums))


@pytest.mark.parametrize("yaw", [0.0, 0.5, np.pi / 2])
def test_a_whole_car_has_its_cross_section_and_half_a_car_half(world: Callable[..., Scene], yaw: float):
    expected = compute_actor_rcs(np.array(["car"]), np.array([np.pi - yaw]))[0]
    assert total(world(("veh0", "car", 20.0, 0.0, yaw))) == pytest.approx(expected, rel=0.3)


def test_what_is_hidden_does_not_answer(world: Callable[..., Scene]):
    free = total(world(("veh0", "car", 30.0, 0.0, np.pi / 2)))
    behind = total(world(("veh0", "car", 30.0, 0.0, np.pi / 2), ("veh1", "truck", 22.0, 1.7, 0.0)))
    assert 0.1 < behind / free < 0.9


def test_classes_and_aspects_differ():
    assert set(ACTOR_RCS) == set(CATEGORIES)
    aspect = np.linspace(0, 2 * np.pi, 73)
    car = 10 * np.log10(compute_actor_rcs(np.full(73, "car"), aspect))
    assert car.max() - car.min() > 8
    assert car[18] > car[9] + 5  # the side outshines the corner
    np.testing.assert_allclose(car, car[::-1], atol=1e-9)
    mean = {name: compute_actor_rcs(np.full(73, name), aspect).mean() for name in CATEGORIES}
    assert mean["pedestrian"] < mean["bicycle"] < mean["motorcycle"] < mean["car"] < mean["van"] < mean["truck"]
    np.testing.assert_allclose(silhouette(np.array([[4.0, 2.0, 1.5]] * 2), np.array([0.0, np.pi / 2])), [3.0, 6.0])


def test_a_flat_wall_glints_where_it_is_met_face_on(world: Callable[..., Scene]):
    scene = world(buildings=WALL)
    points = np.concatenate([sweep(scene, seed, **QUIET)[0] for seed in range(5)])
    wall = points[np.abs(points[:, 0] * np.cos(points[:, 1]) - 55.0) < 2.0]
    face_on, oblique = (
        wall[(low < abs(wall[:, 1])) & (abs(wall[:, 1]) < high), 4] for low, high in ((-1, 0.05), (0.4, 0.9))
    )
    assert np.median(face_on) > np.median(oblique) + 8
