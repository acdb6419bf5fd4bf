"""What the planner computes: as `flcav place` does, with independent sums beside it."""

import json
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Point, Polygon
from shapely.ops import unary_union

from flcav.cli.main import run
from flcav.config import InputError
from flcav.planner.desk import ONE_KIND, lay_out, with_errors
from flcav.planner.exporting import export_placement, write_command
from flcav.planner.placing import (
    Kinds,
    Question,
    Workspace,
    describe_workspace,
    find_best,
    find_new_poles,
    look,
    mount,
    select_errors,
    trace_curve,
)
from flcav.world.map.town import load_town

KINDS, CLASSES = ("miss", "false_positive"), ("Car", "Pedestrian")
TWO_KINDS = Kinds(("near", "far"), (25.0, 60.0), (1.0, 2.5))


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> Path:
    """Errors along the streets of the suburb, of two classes and kinds."""
    path = tmp_path_factory.mktemp("planner") / "errors.csv"
    town, rng = load_town("suburb"), np.random.default_rng(5)
    rows = [np.mean(road[rng.integers(len(road), size=2)], axis=0) for road in town.roads for _ in range(30)]
    lines = [
        f"{x:.2f},{y:.2f},0.8,1,{KINDS[n % 3 == 0]},{CLASSES[n % 4 == 0]},9,0.25,s,t{n}"
        for n, (x, y) in enumerate(rows)
    ]
    path.write_text("x,y,z,weight,kind,class,returns,occlusion,scene,track\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def space(table) -> Workspace:
    return with_errors(lay_out(load_town("suburb")), table)


def placed(capsys, *arguments: object) -> dict:
    with pytest.raises(SystemExit):
        run(["place", *map(str, arguments), "--town", "suburb", "--line-of-sight", "--json"])
    return json.loads(capsys.readouterr().out)


def seen_by(space: Workspace, best, kinds: Kinds) -> set[int]:
    sites = space.sites.xyz
    return {row for site, kind in best.pairs for row in look(space, tuple(sites[site]), kinds.ranges_m[kind], True)[1]}


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_best_is_that_of_place_and_the_sensors_see_what_it_covers(space, table, count, capsys):
    found = placed(capsys, "--errors", table, "--range", 40, "--count", count)
    best = find_best(space, Question(ONE_KIND), count=count)
    assert [str(space.sites.ids[site]) for site, _ in best.pairs] == [str(pair["pole"]) for pair in found["chosen"]]
    assert (best.placed.covered, best.placed.upper_bound, best.placed.optimal) == (
        found["covered"], found["upper_bound"], found["optimal"],
    )  # fmt: skip
    assert len(seen_by(space, best, ONE_KIND)) == found["covered"]


def test_the_best_within_a_cost_is_that_of_place(space, table, tmp_path, capsys):
    (tmp_path / "kinds.csv").write_text("name,range_m,cost\nnear,25,1\nfar,60,2.5\n")
    found = placed(capsys, "--errors", table, "--sensors", tmp_path / "kinds.csv", "--budget", 3.5)
    best = find_best(space, Question(TWO_KINDS), budget=3.5)
    assert (best.placed.covered, best.placed.cost) == (found["covered"], found["cost"])
    assert len(seen_by(space, best, TWO_KINDS)) == found["covered"]


def test_errors_that_are_left_out_weigh_nothing_in_place(space, table, capsys):
    found = placed(capsys, "--errors", table, "--range", 40, "--count", 2, "--class-weight", "Car=0")
    best = find_best(space, Question(ONE_KIND, without=frozenset({"Car"})), count=2)
    assert best.placed.covered_weight == found["covered_weight"]
    assert best.errors == int(select_errors(space.given, frozenset({"Car"})).sum()) < len(space.errors)


def test_the_command_finds_the_same(space, table, capsys):
    command = write_command(space, Question(ONE_KIND), 3)
    assert command.startswith("flcav place --town suburb --errors errors.csv")
    typed = command.replace("errors.csv", str(table)).split()[2:]
    with pytest.raises(SystemExit):
        run(["place", *typed, "--json"])
    assert (
        json.loads(capsys.readouterr().out)["covered"] == find_best(space, Question(ONE_KIND), count=3).placed.covered
    )


def test_errors_beyond_every_pole_are_counted(space):
    best = find_best(space, Question(ONE_KIND), count=4)
    reached = set[int]()
    for site in space.sites.xyz:
        reached |= {*look(space, tuple(site), 40.0, True)[1]}
    assert best.beyond == len(space.errors) - len(reached) > 0


def test_the_visible_area_is_cut_by_houses(space):
    town, site = space.town, space.sites.xyz[0]
    area, _ = look(space, tuple(site), 40.0, True)
    rings = [
        Polygon([[*map(float, pair.split())] for pair in part.split("L")]) for part in area.strip("MZ").split("ZM")
    ]
    seen = unary_union([ring.buffer(0) for ring in rings])
    circle = Point(*site[:2]).buffer(np.sqrt(40.0**2 - 5.0**2))
    assert 0.2 < seen.area / circle.area < 0.8
    assert circle.buffer(1.0).contains(seen)
    assert town.name == "suburb"


def test_own_sites_count_beside_the_poles(space):
    alone = find_best(space, Question(ONE_KIND), count=1)
    uncovered = sorted({*range(len(space.errors))} - seen_by(space, alone, ONE_KIND))
    place = find_new_poles(space, Question(ONE_KIND), 0, uncovered)[0]
    at = mount(space, [(place.site.x, place.site.y)])[0]
    assert len({*look(space, tuple(at), 40.0, True)[1]} & {*uncovered}) == place.errors
    both = find_best(space, Question(ONE_KIND, own=((place.site.x, place.site.y),)), count=2)
    assert both.placed.covered >= alone.placed.covered + place.errors


@pytest.mark.parametrize("kinds", [ONE_KIND, TWO_KINDS])
def test_the_curve_rises_to_all_that_can_be_reached(space, kinds):
    steps = trace_curve(space, Question(kinds))
    covered = [step.placed.covered for step in steps]
    assert covered == sorted(covered)
    assert covered[-1] == len(space.errors) - steps[-1].beyond
    assert all(step.placed.optimal for step in steps)


def test_a_town_without_errors_has_a_map_and_no_best():
    space = lay_out(load_town("suburb"))
    assert describe_workspace(space)["errors"] == []
    assert look(space, tuple(space.sites.xyz[0]), 40.0, True)[0].startswith("M")
    with pytest.raises(InputError, match="there are no errors"):
        find_best(space, Question(ONE_KIND), count=1)


def test_exports_name_the_places_of_the_sensors(space):
    question = Question(ONE_KIND, own=((1.0, 2.0),))
    files = export_placement(space, question, [(0, 0), (len(space.sites.ids), 0)])
    rows = str(files["csv"]).splitlines()
    assert rows[0] == "id,sensor,range_m,x,y,z,latitude,longitude,street"
    assert [row.split(",")[0] for row in rows[1:]] == ["1", "own 1"]
    point = json.loads(str(files["geojson"]))["features"][0]["geometry"]["coordinates"]
    assert point == [float(rows[1].split(",")[7]), float(rows[1].split(",")[6])]
    assert "poles: [1]}" in str(files["yaml"])
