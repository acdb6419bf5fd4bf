"""Samples: inside the domain by what is measured of them, balanced, paired, and valid as recipes and scenarios."""

import shutil
import xml.etree.ElementTree as ElementTree
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import yaml

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.driving.scripts import write_script
from flcav.odd.coverage import collect_runs, list_covered, merge_runs
from flcav.odd.domain import Domain, read_domain
from flcav.odd.measure import measure_domain
from flcav.odd.openscenario import to_openscenario
from flcav.odd.sampling import CASE, CASES, METHODS, Axis, SampledScenario, Space, make_recipe, sample_domain
from flcav.odd.scenery import Scenery
from flcav.sources.recipe import load_recipe, parse_recipe
from flcav.world.map.town import load_town
from flcav.world.shapes import SHAPES


@pytest.fixture(scope="module")
def space(urban: Domain, ring: Scenery) -> Space:
    return Space(urban, [ring])


@pytest.mark.parametrize("method", METHODS)
def test_samples_are_inside_and_their_pairs_are_counted(method: str, space: Space):
    drawn = sample_domain(space, 60, method, seed=4)
    assert len(drawn.samples) == 60
    for each in drawn.samples:
        weather = each.weather
        assert weather.visibility_m >= 100  # of urban.yaml
        assert weather.rain_mm_h <= 20
        assert weather.rain_mm_h < 0.3 or weather.cloud_cover >= 0.6
        assert each.case in CASES[each.place.kind]
        assert each.buckets["scenery.junction"] == each.place.kind
    names = [axis.attribute for axis in space.axes] + [CASE]
    had = {(a, s.buckets[a], b, s.buckets[b]) for s in drawn.samples for a, b in combinations(names, 2)}
    assert drawn.pairs == len(had)  # none is a pair that is held impossible
    assert drawn.possible == len(space.possible_pairs())
    assert drawn.pairwise > 0.8


@pytest.mark.parametrize("method", METHODS)
def test_the_seed_decides(method: str, space: Space):
    one, same, other = (sample_domain(space, 5, method, seed).samples for seed in (1, 1, 2))
    assert one == same
    assert one != other


def test_all_pairs_are_covered_by_enough_sobol_points(space: Space):
    assert sample_domain(space, 600, "sobol").pairwise == 1.0


def test_an_axis_goes_over_its_buckets_equally():
    axis = Axis("sight", ("near", "far"), ((10.0, 100.0), (100.0, 1000.0)), logarithmic=True)
    assert [axis.at(share)[0] for share in (0.0, 0.49, 0.5, 0.99)] == ["near", "near", "far", "far"]
    assert axis.at(0.25)[1] == pytest.approx(np.sqrt(1000.0))


def test_what_runs_did_not_cover_is_drawn_first(space: Space, urban: Domain, drive: Dataset):
    drawn = sample_domain(space, 4, "coverage")
    assert len({each.place.kind for each in drawn.samples}) == 4  # each kind of place once before any twice
    covered = merge_runs(list(collect_runs(urban, drive, measure_domain(drive)).values()))
    seen = {bucket: set(row.covered) for row in list_covered(covered) for bucket in [row.attribute]}
    first = sample_domain(space, 2, "coverage", covered=covered).samples
    for attribute in ("environment.rainfall", "environment.visibility"):  # of which it covered one bucket
        assert len(seen[attribute]) == 1
        assert not {each.buckets[attribute] for each in first} & seen[attribute]


def test_a_domain_with_conditions_on_light_draws_no_night(ring: Scenery):
    rural = Space(read_domain("rural"), [ring])
    assert all(each.weather.sun_elevation_deg >= -6 for each in sample_domain(rural, 40, "lhs").samples)
    sun = next(axis for axis in rural.axes if axis.attribute == "environment.sun_elevation")
    assert sun.labels == ("[-6, 10)", "[10, 90]")


def test_a_domain_without_places_is_refused(ring: Scenery):
    with pytest.raises(InputError, match="mine: no place of ring is inside it"):
        Space(read_domain("mine"), [ring])


def test_a_domain_that_no_rig_fits_is_refused(ring: Scenery, odd_file):
    far = odd_file("MODULES: {m: {INCLUDE_AND: {sensing_range: '>= 500 m', junction: [roundabout]}}}")
    with pytest.raises(InputError, match="no rig of flcav"):
        Space(read_domain(far), [ring])


def test_a_recipe_puts_the_case_at_its_place(space: Space, ring: Scenery):
    for number, each in enumerate(sample_domain(space, 20, "sobol").samples):
        recipe = parse_recipe(make_recipe(each, ring, number), "sample")
        assert recipe.scenarios[0].position == pytest.approx((each.place.x, each.place.y), abs=0.06)
        assert recipe.scenarios[0].kind == each.case
        assert recipe.weather.at(0.0).rain_mm_h == pytest.approx(each.weather.rain_mm_h, abs=1e-4)
        assert set(recipe.poles) <= set(ring.town.poles.id.tolist())


def test_a_recipe_in_a_town_of_ones_own_names_its_folder(urban: Domain, ring: Scenery, tmp_path: Path):
    shutil.copytree(ring.town.net.parent, tmp_path / "own")
    own = Scenery(load_town(tmp_path / "own"))
    (first,) = sample_domain(Space(urban, [own]), 1, "sobol").samples
    recipe = parse_recipe(make_recipe(first, own, 0), "sample")
    assert load_town(recipe.town).name == first.place.town == "own"


def scenario(space: Space, case: str) -> tuple[SampledScenario, ElementTree.Element]:
    drawn = sample_domain(space, 200, "sobol").samples
    found = next(each for each in drawn if each.case == case)
    return found, ElementTree.fromstring(to_openscenario(found, "ring.xodr"))


@pytest.mark.parametrize("case", sorted({case for cases in CASES.values() for case in cases}))
def test_a_scenario_has_its_actors_where_they_start(case: str, space: Space):
    found, root = scenario(space, case)
    header = root.find("FileHeader")
    assert header is not None
    assert (header.get("revMajor"), header.get("revMinor")) == ("1", "2")
    named = {each.get("name") for each in root.iter("ScenarioObject")}
    script = write_script(found.case, 10.0)
    assert named == {"ego", *(actor.name for actor in script.actors)}
    assert {each.get("entityRef") for each in root.iter("EntityRef")} <= named
    ego = root.find(".//Private[@entityRef='ego']//WorldPosition")
    assert ego is not None
    assert (float(ego.get("x", "nan")), float(ego.get("y", "nan"))) == pytest.approx(found.place.start[:2], abs=1e-3)
    sun = root.find(".//Sun")
    assert sun is not None
    assert float(sun.get("elevation", "nan")) == pytest.approx(np.radians(found.weather.sun_elevation_deg), rel=1e-4)
    for actor in script.actors:
        assert actor.shape in [shape.name for shape in SHAPES[actor.category]]
    assert to_openscenario(found, "ring.xodr") == to_openscenario(found, "ring.xodr")


def test_the_command_writes_recipes_that_load_and_refuses_a_used_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    command = ["odd", "sample", "urban", "--town", "ring", "--count", "12", "--method", "lhs", "--out"]
    with pytest.raises(SystemExit) as ended:
        run([*command, str(tmp_path / "drawn")])
    assert ended.value.code == 0
    paths = sorted((tmp_path / "drawn").glob("*.yaml"))
    assert [path.name for path in paths] == [f"{number:02}.yaml" for number in range(1, 13)]
    assert {load_recipe(path).town for path in paths} == {"ring"}
    assert yaml.safe_load(paths[4].read_text())["seed"] == 4
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        run([*command, str(tmp_path / "drawn")])
    told = capsys.readouterr()
    assert (ended.value.code, told.out) == (2, "")
    assert "has recipes already" in told.err
