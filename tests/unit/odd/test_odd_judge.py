"""Three-valued judgement, against rules written out by hand; perceived verdicts against true ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.odd.domain import Domain, read_domain
from flcav.odd.judge import INSIDE, OUTSIDE, UNKNOWN, compare_verdicts, judge_frames, judge_values
from flcav.odd.measure import Measurements, _narrow, measure_domain, perceive

URBAN = read_domain("urban")
FINE = {
    "drivable_area_type": "minor_road",
    "speed_limit": 30.0,
    "lanes": 1.0,
    "surface_type": "asphalt",
    "junction": "none",
    "driving_side": "right",
    "rainfall": 0.0,
    "visibility": 5000.0,
    "ego_speed": 20.0,
    "agents": 3.0,
    "field_of_view": 360.0,
    "sensing_range": 100.0,
}
RULES = {  # of domains/urban.yaml, by hand
    "speed_limit": lambda value: value <= 55,
    "rainfall": lambda value: value <= 20,
    "visibility": lambda value: value >= 100,
    "agents": lambda value: value <= 60,
    "junction": lambda value: value in ("none", "t_junction", "crossroad", "roundabout"),
}
VALUES = st.fixed_dictionaries(
    {
        "speed_limit": st.one_of(st.none(), st.sampled_from([0.0, 55.0, 55.001, 130.0])),
        "rainfall": st.one_of(st.none(), st.floats(0, 60)),
        "visibility": st.one_of(st.none(), st.floats(5, 2e4)),
        "agents": st.one_of(st.none(), st.integers(0, 100).map(float)),
        "junction": st.one_of(st.none(), st.sampled_from(["none", "t_junction", "crossroad", "other"])),
    }
)


@given(VALUES)
def test_a_verdict_is_kleenes(values: dict):
    held = [None if value is None else RULES[name](value) for name, value in values.items()]
    wanted = OUTSIDE if False in held else UNKNOWN if None in held else INSIDE
    assert judge_values(URBAN, FINE | values) == wanted


@pytest.mark.parametrize("name", FINE)
def test_nothing_is_inside_by_silence(name: str):
    assert judge_values(URBAN, FINE) == INSIDE
    assert judge_values(URBAN, FINE | {name: None}) == UNKNOWN
    assert judge_values(URBAN, {each: value for each, value in FINE.items() if each != name}) == UNKNOWN


def test_frames_are_judged_one_by_one(drive: Dataset, urban: Domain):
    measured = measure_domain(drive)
    found = judge_frames(urban, measured)
    assert found.verdict.tolist() == [judge_values(urban, row) for row in measured.rows()]
    assert judge_frames(read_domain("mine"), measured).count(INSIDE) == 0


def test_modules_that_put_frames_outside_are_named(urban: Domain):
    rows = [FINE, FINE | {"visibility": 50.0}, FINE | {"visibility": 50.0, "lanes": 5.0}]
    columns = {name: np.array([row[name] for row in rows]) for name in FINE}
    found = judge_frames(urban, Measurements((0, 1, 2), columns))
    assert dict(found.failed) == {"urban_environment": 2, "urban_scenery": 1}


def test_an_unbound_domain_is_refused(odd_file):
    path = odd_file("TAXONOMY: {wind: float velocity}\nMODULES: {m: {INCLUDE_AND: {wind: '<= 5 m/s'}}}")
    with pytest.raises(InputError, match="measures 'wind'"):
        judge_frames(read_domain(path), Measurements((), {}))


def test_precision_and_recall_are_of_what_truth_decides():
    truth = [INSIDE, INSIDE, OUTSIDE, OUTSIDE, UNKNOWN]
    seen = [INSIDE, OUTSIDE, OUTSIDE, UNKNOWN, INSIDE]
    found = compare_verdicts(truth, seen)
    assert (found.frames, found.undecided) == (4, 1)
    rates = found.outside.precision, found.outside.recall, found.inside.precision, found.inside.recall
    assert [rate and rate.mean for rate in rates] == [0.5, 0.5, 1.0, 0.5]


def test_a_class_of_weather_across_a_limit_does_not_decide(urban: Domain):
    low = {"visibility": np.array([50.0, 200.0]), "light": np.array(["day", "day"])}
    high = {"visibility": np.array([400.0, 400.0]), "light": np.array(["day", "night"])}
    found = _narrow(urban, low, high)  # urban: visibility >= 100 m
    assert np.isnan(found["visibility"][0])
    assert 200 < found["visibility"][1] < 400
    assert found["light"].tolist() == ["day", ""]


def test_without_networks_perception_knows_no_weather_and_no_road_users(drive: Dataset, urban: Domain):
    measured = measure_domain(drive)
    seen = perceive(urban, drive, measured.frames, None, None)
    assert judge_frames(urban, seen).count(UNKNOWN) == len(measured)
    assert seen.columns["junction"].tolist() == measured.columns["junction"].tolist()


def test_weather_needs_a_camera(drive: Dataset, urban: Domain):
    from flcav.perception.networks import resolve_network
    from flcav.perception.tasks import task_named

    with pytest.raises(InputError, match="has no camera, which the weather network needs"):
        perceive(urban, drive, measure_domain(drive).frames, resolve_network(task_named("weather"), None), None)
