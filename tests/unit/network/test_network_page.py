"""What docs/network.md says in numbers is what the code has."""

import re
from pathlib import Path

import numpy as np
import pytest

from flcav.network.clock import rounds
from flcav.network.clock.rounds import RoundRules
from flcav.network.radio.budget import LAWS, PathState, Radio, lone_rate_bps, path_loss_db, received_dbm
from flcav.network.radio.links import Wireline

PAGE = (Path(__file__).parents[3] / "docs" / "network.md").read_text(encoding="utf-8")


def test_laws_are_those_of_the_table():
    rows = re.findall(r"^\| (urban|highway) \| (\w+) \| (.*?) \| (\d+) \| (\d+) \|$", PAGE, re.M)
    said = {
        (place, PathState[state.upper()]): (law, float(sigma), float(far)) for place, state, law, sigma, far in rows
    }
    assert {*said} == {(place, state) for place, laws in LAWS.items() for state in laws}
    for (place, state), (law, sigma, far) in said.items():
        known = LAWS[place][state]
        assert (known.sigma_db, known.correlation_m) == (sigma, far)
        if "as LOS" not in law:
            numbers = [float(number) for number in re.findall(r"[\d.]+", law)]
            assert numbers == [known.intercept_db, known.slope_db, known.frequency_db]


def test_defaults_are_those_of_the_tables():
    defaults = dict(re.findall(r"^\| `(\w+)`(?: \(α\))? \| `?([−\w.]+)", PAGE, re.M))
    radio = Radio()
    for name in Radio.model_fields:
        said, known = defaults[name].replace("−", "-"), getattr(radio, name)
        assert said == known if isinstance(known, str) else said == "true" if known is True else float(said) == known
    wire = re.search(r"^\| `wireline.rate_mbps`, `wireline.latency_s` \| (\d+), ([\d.]+) \|", PAGE, re.M)
    assert wire is not None
    assert (float(wire[1]), float(wire[2])) == (Wireline().rate_mbps, Wireline().latency_s)
    assert f"| `rounds.outage_s` | {RoundRules().outage_s} |" in PAGE
    assert f"| `rounds.handover_margin_m` | {RoundRules().handover_margin_m:g} |" in PAGE


def test_reasons_are_those_that_clients_are_dropped_for():
    reasons = (
        rounds.LEFT_TOWN,
        rounds.NO_COVERAGE,
        rounds.NEARER.format(unit="poleN"),
        rounds.DEADLINE,
        rounds.TRACE_ENDS,
    )
    rows = re.findall(r"^\| `([\w ]+)` \| ", PAGE.partition("| `dropped` | when |")[2], re.M)
    assert {*rows[:5]} == {*reasons}


def test_reach_behind_buildings_is_as_the_page_says():
    said = re.search(r"falls below that at (\d+) m, to half at (\d+) m, and to 0 at (\d+) m", PAGE)
    assert said is not None
    distance = np.arange(1.0, 700.0)
    rate = lone_rate_bps(received_dbm(path_loss_db(distance, PathState.NLOS, 5.9), Radio()), Radio())
    found = [distance[(rate < limit).argmax()] for limit in (rate[0], rate[0] / 2, 1.0)]
    assert found == pytest.approx([float(said[1]), float(said[2]), float(said[3])], abs=1)
    assert lone_rate_bps(received_dbm(path_loss_db(500.0, PathState.LOS, 5.9), Radio()), Radio()) == 20e6
