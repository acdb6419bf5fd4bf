"""What a simulated run promises, on every town."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon

from flcav.config import InputError
from flcav.geometry import wrap_angle
from flcav.statistics.streams import derive_seed
from flcav.world.map.census import measure_traffic_density
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import KERB_M, TOWNS, Town, load_town
from flcav.world.shapes import SHAPES
from flcav.world.trace import CATEGORIES, Trace
from flcav.world.traffic.simulation import HURRY_MPS, Walkers
from flcav.world.traffic.traffic import simulate, simulate_drives

TIMES_S = 60.0 + 0.1 * np.arange(300)
ROUGHLY = {
    "suburb": (20, 35, 45),
    "grid": (40, 70, 15),
    "ring": (30, 50, 15),
    "arterial": (28, 40, 10),
}  # moving vehicles from, to; parked from


@pytest.fixture(scope="module", params=TOWNS)
def run(request: pytest.FixtureRequest) -> tuple[Town, Trace]:
    town = load_town(request.param)
    return town, simulate(town, seed=1, cavs=3, times_s=TIMES_S)


def named(trace: Trace, *prefixes: str) -> np.ndarray:
    return np.array([str(name).startswith(prefixes) for name in trace.actor])


def test_numbers_of_actors(run: tuple[Town, Trace]) -> None:
    town, trace = run
    low, high, parked = ROUGHLY[town.name]
    moving = trace.present[:, named(trace, "cav", "veh")].sum(axis=1)
    assert ((moving >= low) & (moving <= high)).all()
    assert named(trace, "parked").sum() >= parked
    assert trace.present[:, named(trace, "ped")].any(axis=0).sum() >= 15
    assert set(trace.category) <= set(CATEGORIES)
    assert trace.present.any(axis=0).all()


def test_cavs_are_sedans_under_way_all_the_time(run: tuple[Town, Trace]) -> None:
    _, trace = run
    cavs = named(trace, "cav")
    assert trace.actor[cavs].tolist() == ["cav0", "cav1", "cav2"]
    assert trace.present[:, cavs].all()
    assert [SHAPES["car"][shape].name for shape in trace.shape[cavs]] == ["sedan"] * 3


def test_sizes_are_those_of_the_shapes(run: tuple[Town, Trace]) -> None:
    _, trace = run
    for category, shape, size in zip(trace.category, trace.shape, trace.size):
        assert tuple(size) == SHAPES[str(category)][shape][1:]


def test_motion_agrees_with_velocity(run: tuple[Town, Trace]) -> None:
    _, trace = run
    vehicle = named(trace, "cav", "veh")
    moved = np.diff(trace.position[:, vehicle], axis=0) / 0.1
    mean = (trace.velocity[1:, vehicle] + trace.velocity[:-1, vehicle]) / 2
    error = np.linalg.norm(moved - mean, axis=2)
    assert np.nanmedian(error) < 0.1
    assert np.nanpercentile(error, 99) < 2.0
    assert np.nanmean(np.linalg.norm(mean, axis=2)) > 1.5
    turned = np.abs(wrap_angle(np.diff(trace.yaw[:, vehicle], axis=0)))
    assert np.nanmax(turned) < np.radians(15)


def test_pedestrians_walk_as_fast_as_people_do_and_as_recorded(run: tuple[Town, Trace]) -> None:
    _, trace = run
    walked = trace.position[:, named(trace, "ped")]
    velocity = trace.velocity[:, named(trace, "ped")]
    assert np.nanmax(np.linalg.norm(np.diff(walked, axis=0), axis=2)) < (HURRY_MPS + 0.5) * 0.1  # and turns about
    moved = (walked[5:] - walked[:-5])[..., :2]
    expected = 0.1 * (velocity[:-5] / 2 + velocity[1:-4] + velocity[2:-3] + velocity[3:-2] + velocity[4:-1])
    expected += 0.1 * velocity[5:] / 2
    assert np.nanmax(np.linalg.norm(moved - expected[..., :2], axis=2)) < 0.35


def test_a_pedestrian_who_changes_the_crossing_walks_there() -> None:
    """Seed 5 of `grid`: ped6 waits at one end of a corner and then takes the crossing at the other, 13 m away."""
    trace = simulate(load_town("grid"), seed=derive_seed(5, "traffic", 0), cavs=5, times_s=np.array([59.5, 60.0, 60.5]))
    ped6 = trace.actor.tolist().index("ped6")
    distance = np.linalg.norm(np.diff(trace.position[:, ped6], axis=0), axis=1)
    assert 0.2 < distance.max() < 0.5 * HURRY_MPS


def test_walkers_walk_what_their_model_hops() -> None:
    walkers = Walkers(0.1)
    walkers.follow({"a": (0.0, 0.0, 90.0, 0.0), "b": (5.0, 5.0, 0.0, 1.0)})
    walkers.follow({"a": (2.0, 0.0, 90.0, 1.0), "b": (5.0, 5.1, 0.0, 1.0)})
    assert walkers.states["b"] == (5.0, 5.1, 0.0, 1.0)
    assert walkers.states["a"] == pytest.approx((0.25, 0.0, 90.0, HURRY_MPS))
    for _ in range(6):
        walkers.follow({"a": (2.0, 1.0, 0.0, 0.0)})  # round a corner
    assert walkers.states["a"][:2] == pytest.approx((1.75, 0.0))
    for _ in range(6):
        walkers.follow({"a": (2.0, 1.0, 0.0, 0.0)})
    assert walkers.states == {"a": (2.0, 1.0, 0.0, 0.0)}


def test_acceleration_and_yaw_rate_are_those_of_the_neighbouring_steps(run: tuple[Town, Trace]) -> None:
    _, trace = run
    moving = named(trace, "cav", "veh")
    velocity, yaw = trace.velocity[:, moving], trace.yaw[:, moving]
    measured = (velocity[2:] - velocity[:-2]) / 0.2
    there = ~np.isnan(measured)
    np.testing.assert_allclose(trace.acceleration[1:-1, moving][there], measured[there], atol=1e-9)
    turned = wrap_angle(yaw[2:] - yaw[:-2]) / 0.2
    there = ~np.isnan(turned)
    np.testing.assert_allclose(trace.yaw_rate[1:-1, moving][there], turned[there], atol=1e-9)
    assert np.nanmax(np.abs(turned)) > 0.3
    np.testing.assert_array_equal(np.isnan(trace.yaw_rate), ~trace.present)
    assert (trace.acceleration[:, named(trace, "parked")] == 0).all()


def test_a_step_on_from_its_rates_an_actor_is_where_it_really_goes(run: tuple[Town, Trace]) -> None:
    _, trace = run
    on = trace.position[:-1] + 0.1 * trace.velocity[:-1] + 0.005 * trace.acceleration[:-1]
    error = np.linalg.norm(on - trace.position[1:], axis=2)
    assert np.nanmean(error) < 0.02
    assert np.nanpercentile(error, 99) < 0.15


def test_parked_vehicles_stand_still_at_the_side_of_the_road(run: tuple[Town, Trace]) -> None:
    town, trace = run
    parked = named(trace, "parked")
    assert trace.present[:, parked].all()
    assert (trace.velocity[:, parked] == 0).all()
    assert (trace.position[0, parked] == trace.position[-1, parked]).all()
    roads = shapely.union_all([Polygon(outline) for outline in town.roads])
    sidewalks = shapely.union_all([Polygon(outline) for outline in town.sidewalks])
    for place in boxes(trace, 0)[parked]:
        assert place.difference(roads).area < 0.2
        assert place.distance(sidewalks) < 2.2  # a bicycle lane may run between


def test_vehicles_keep_apart_and_to_the_road(run: tuple[Town, Trace]) -> None:
    town, trace = run
    roads = shapely.union_all([Polygon(outline) for outline in town.roads])
    off, overlapping, seen = 0, 0, 0
    for instant in range(0, len(trace.time_s), 50):
        vehicles = boxes(trace, instant)[trace.present[instant] & (trace.category != "pedestrian")]
        a, b = shapely.STRtree(vehicles).query(vehicles, predicate="intersects")
        overlapping += int((shapely.area(shapely.intersection(vehicles[a], vehicles[b]))[a < b] > 0.1).sum())
        off += int((shapely.area(shapely.difference(vehicles, roads)) > 1.5).sum())
        seen += len(vehicles)
    assert overlapping <= 0.005 * seen
    assert off <= 0.005 * seen


def test_pedestrians_stand_on_the_sidewalk_or_in_the_road(run: tuple[Town, Trace]) -> None:
    _, trace = run
    height = trace.position[:, named(trace, "ped"), 2]
    assert set(np.unique(height[~np.isnan(height)])) == {0.0, KERB_M}
    assert np.nanmean(height == KERB_M) > 0.5


def test_lights_go_through_their_colours(run: tuple[Town, Trace]) -> None:
    town, trace = run
    assert trace.light_state.shape == (len(trace.time_s), len(trace.light))
    if town.name == "suburb":
        assert not len(trace.light)
    else:
        assert {"G", "r", "y"} <= set(np.unique(trace.light_state)) <= set("Ggyrs")
        assert (trace.light_state != trace.light_state[0]).any(axis=0).mean() > 0.5


def test_same_seed_same_bytes_and_another_seed_another_run(tmp_path: Path) -> None:
    town = load_town("ring")
    times_s = np.array([20.0, 40.0])
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        simulate(town, seed=seed, cavs=2, times_s=times_s).save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    one, other = Trace.load(tmp_path / "a"), Trace.load(tmp_path / "c")
    parked_one = one.position[0, named(one, "parked"), :2].tolist()
    assert not {tuple(at) for at in parked_one} & {tuple(at) for at in other.position[0, named(other, "parked"), :2]}


def test_sampling_does_not_change_the_run() -> None:
    town = load_town("ring")
    dense = simulate(town, seed=2, cavs=1, times_s=30.0 + 0.1 * np.arange(21))
    sparse = simulate(town, seed=2, cavs=1, times_s=np.array([30.0, 32.0]))
    kept = np.flatnonzero(np.isin(dense.actor, sparse.actor))
    np.testing.assert_array_equal(dense.position[[0, 20]][:, kept], sparse.position)
    np.testing.assert_allclose(dense.acceleration[[0, 20]][:, kept], sparse.acceleration, atol=1e-9)
    np.testing.assert_allclose(dense.yaw_rate[[0, 20]][:, kept], sparse.yaw_rate, atol=1e-9)


@pytest.mark.parametrize("name", ["ring", "hilly_ring"])
def test_drives_are_the_same_motion_at_every_step(name: str) -> None:
    town, times_s = load_town(name), np.array([30.0, 32.0, 32.5])
    about = {"seed": 2, "cavs": 2, "times_s": times_s}
    trace, drives = simulate_drives(town, lead_s=5.0, **about)
    plain = simulate(town, **about)
    assert drives.actor.tolist() == ["cav0", "cav1"]
    np.testing.assert_allclose(drives.time_s, np.arange(250, 326) / 10)
    own, rows = [trace.actor.tolist().index(name) for name in drives.actor], np.array([50, 70, 75])
    for field in ("position", "yaw", "velocity", "acceleration", "yaw_rate", *(("tilt",) if town.relief else ())):
        np.testing.assert_array_equal(getattr(trace, field), getattr(plain, field))
        np.testing.assert_allclose(getattr(drives, field)[rows], getattr(trace, field)[:, own], atol=1e-12)
    moved = np.diff(drives.position, axis=0) / 0.1  # its speed is SUMO's, and nearly that of its positions
    assert np.abs(moved - drives.velocity[1:]).mean() < 0.2
    late = simulate_drives(town, lead_s=100.0, **about)[1]
    assert late.time_s[0] == 0.1


@pytest.mark.slow
def test_pole_8_of_grid_is_the_densest() -> None:
    town = load_town("grid")
    for seed in range(3):
        trace = simulate(town, seed=seed, cavs=4, times_s=60.0 + 5.0 * np.arange(20))
        for range_m in (30.0, 40.0, 50.0):
            assert town.poles.id[np.argmax(measure_traffic_density(town.poles.position, trace, range_m))] == 8, (
                seed,
                range_m,
            )


def test_density_counts_who_is_within_range() -> None:
    town = load_town("grid")
    trace = simulate(town, seed=4, cavs=1, times_s=np.array([60.0, 61.0]))
    expected = np.zeros(len(town.poles.id))
    for pole, mount in enumerate(town.poles.position):
        for instant in range(2):
            for actor in np.flatnonzero(trace.present[instant]):
                centre = trace.position[instant, actor] + [0, 0, trace.size[actor, 2] / 2]
                expected[pole] += np.sqrt(((centre - mount) ** 2).sum()) <= 35.0
    np.testing.assert_array_equal(measure_traffic_density(town.poles.position, trace, 35.0), expected / 2)
    np.testing.assert_array_equal(measure_traffic_density(town.poles.position, [trace, trace], 35.0), expected / 2)


def test_towns_differ_in_who_drives() -> None:
    shares = {}
    for name in TOWNS:
        trace = simulate(load_town(name), seed=1, cavs=0, times_s=np.array([60.0]))
        of_class = np.isin(trace.category, ("car", "van"))
        shares[name] = float((trace.category[of_class] == "van").mean())
    assert shares["suburb"] < 0.05 < shares["ring"] < shares["grid"]
    assert shares["grid"] >= 0.3


@pytest.mark.parametrize(
    ("times_s", "cavs", "message"),
    [
        ([], 1, "ascending multiples"),
        ([0.0], 1, "above 0"),
        ([60.05], 1, "multiples of 0.1"),
        ([61.0, 60.0], 1, "ascending"),
        ([60.0], -1, "cavs = -1"),
        ([0.1], 400, "under way"),
    ],
)
def test_bad_requests_are_named(times_s: list[float], cavs: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(load_town("ring"), seed=1, cavs=cavs, times_s=np.array(times_s))


def boxes(trace: Trace, instant: int) -> np.ndarray:
    rows = zip(trace.position[instant], trace.yaw[instant], trace.size)
    return np.array([make_footprint(x, y, yaw, length, width) for (x, y, _), yaw, (length, width, _) in rows])
