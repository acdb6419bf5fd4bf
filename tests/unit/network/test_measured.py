"""Measured throughput in place of the radio: what is read, how long transfers take, and what plans make of it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.federation.links.metered import Outage
from flcav.federation.rules import Rules
from flcav.network.clock.buffers import BufferClock
from flcav.network.clock.records import ClientWork
from flcav.network.clock.rounds import NetworkSettings, RoundRules
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import Wireline
from flcav.network.radio.measured import link_measured, load_throughput
from flcav.optimization.allocation.fleet import allocate_fleet
from flcav.optimization.allocation.uploads import measure_links
from flcav.optimization.problem import Problem
from flcav.runs.driving import Fleet, drive_rounds, fix_throughput, link_drive, link_scenes, measure_uplinks

MB = 1_000_000
TABLE = """vehicle,time [s],Mbit/s,link
grid/cav0,100,8,
grid/cav0,110,4,wireless
grid/cav0,120,4,wireless
cav1,100,2,Wireless
cav1,105,20,wireless
cav1,115,20,wireless
cav1,125,20,wireless
grid,100,100,wireline
ring,100,40,wireline
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "rates.csv"
    path.write_text(TABLE, encoding="utf-8")
    return path


def bits_until(steps: list[tuple[float, float]], start: float, bits: float) -> float:
    """Return when so many bits have passed from `start` on, by rates [bit/s] that hold until the next step."""
    now = start
    for (begins, rate), (ends, _) in zip(steps, [*steps[1:], (np.inf, 0.0)]):
        if ends <= now:
            continue
        span = ends - max(now, begins)
        if bits <= rate * span:
            return now + bits / rate
        bits, now = bits - rate * span, ends
    raise AssertionError


def test_rounds_take_the_time_of_the_measured_rates_one_after_another(table: Path) -> None:
    """Nobody shares a band; round 2 begins when round 1 ended, and the table repeats after its 35 s."""
    links = link_measured(load_throughput(table), Radio(), ("cav0", "cav1"), "grid")
    assert links.period_s == 35.0  # cav1's last rate holds as long as the longest before it, 10 s
    fleet = Fleet("grid", ("grid/cav0", "grid/cav1"), 2 * MB, 4 * MB, 1.0, {})
    driven = drive_rounds(fleet, [links], NetworkSettings(), Rules(), range(1, 6), 0)
    rates = {
        "cav0": [(0.0, 8e6), (10.0, 4e6)],
        "cav1": [(0.0, 2e6), (5.0, 20e6), (35.0, 2e6), (40.0, 20e6)],
    }
    ends = 0.0
    for record in driven.records[:2]:
        assert record.start_s == pytest.approx(ends)
        for client in record.clients:
            own = rates[client.client]
            assert client.end_s == pytest.approx(bits_until(own, bits_until(own, ends, 16e6) + 1.0, 32e6))
        ends = max(client.end_s for client in record.clients)
    assert driven.outages[3, "grid/cav0"].reason == "left the town"  # its last rate holds for 10 s, until 30 s
    assert driven.outages[4, "grid/cav0"] == Outage("not in the town")
    last = driven.records[4]
    assert (last.start_s < 35.0, last.clients[0].client) == (True, "cav1")
    own = rates["cav1"]
    assert last.end_s == pytest.approx(bits_until(own, bits_until(own, last.start_s, 16e6) + 1.0, 32e6))
    assert last.end_s > 40.0


def test_a_vehicle_is_away_where_it_was_not_measured(tmp_path: Path) -> None:
    path = tmp_path / "rates.csv"
    path.write_text("vehicle,t,rate\ncav0,0,8\ncav0,1,8\ncav1,0,8\ncav1,20,8\ncav2,5,8\ncav2,6,0\ncav2,7,0\n")
    links = link_measured(load_throughput(path), Radio(), ("cav0", "cav1", "cav2"))
    fleet = Fleet("grid", ("grid/cav0", "grid/cav1", "grid/cav2"), 4 * MB, 0, 0.0, {})
    driven = drive_rounds(fleet, [links], NetworkSettings(), Rules(), (1, 2), 0)
    assert driven.outages[1, "grid/cav0"].reason == "left the town"
    assert driven.outages[1, "grid/cav2"] == Outage("not in the town")
    assert {key for key in driven.outages if key[0] == 2} == {(2, "grid/cav0"), (2, "grid/cav2")}


def test_buffers_fill_by_measured_rates(table: Path) -> None:
    links = link_measured(load_throughput(table), Radio(), ("cav0", "cav1"), "grid")
    work = [ClientWork("cav0", MB, 1.0, MB), ClientWork("cav1", MB, 1.0, MB)]
    clock = BufferClock([links] * 3, work, 1, RoundRules())
    assert clock.fill().end_s == pytest.approx(3.0)  # 8 Mbit at 8 Mbit/s, training, and again
    assert clock.fill().end_s == pytest.approx(5.4)  # cav1: 8 Mbit at 2 Mbit/s, training, 8 Mbit at 20 Mbit/s


def test_a_plan_has_the_mean_rates_and_seconds_follow(table: Path) -> None:
    curve = {"model": "additive", "floor": 0.05, "pretrain": {"a": 0.51, "b": 0.1}}
    limits = {"samples": (30, 30), "edge_rounds": (0, 0), "cloud_rounds": (0, 0)}
    task = {"name": "t", "sample_mb": 1.0, "model_mb": 6.0, "edge_groups": (2,), "limits": limits, "curve": curve}
    asked = parse_config(Problem, {"budgets_mb": {"wireless": 90, "wireline": 90}, "tasks": [task]}, "problem")
    problem = measure_links(asked, load_throughput(table))
    links = problem.tasks[0].uplink_mbps
    assert links is not None
    mean0, mean1 = (10 * 8 + 20 * 4) / 30, (5 * 2 + 30 * 20) / 35
    assert links["grid/cav0"].wireless == pytest.approx(mean0)
    assert links["cav1"].wireless == pytest.approx(mean1)
    assert links["cav1"].wireline is None
    _, shares = allocate_fleet(problem)
    for share in shares["t"]:
        assert share.busy_s == pytest.approx(8 * share.samples / links[share.vehicle].wireless)
    few = asked.model_copy(update={"tasks": (asked.tasks[0].model_copy(update={"edge_groups": (3,)}),)})
    with pytest.raises(InputError, match="names 2 vehicles, edge_groups have 3"):
        measure_links(few, load_throughput(table))


def split_of(*vehicles: str) -> Any:
    keys = [SimpleNamespace(agent=name, scene="s") for name in vehicles]
    return SimpleNamespace(data=SimpleNamespace(keys=keys), vehicles=range(len(keys)))


def test_a_run_takes_the_file_beside_its_recipe_and_no_poles(table: Path) -> None:
    settings = fix_throughput(NetworkSettings(throughput="rates.csv"), table.parent)
    assert settings.wireline == Wireline(rate_mbps=40.0)  # the slower edge server's
    placed: Any = SimpleNamespace(region="grid", poles=())
    (links,) = link_scenes(split_of("cav0", "cav1"), placed, settings, 5, 1)
    assert links.unit == ("measured",)
    assert link_drive("grid", split_of("cav1"), settings, 40.0, 1, recorded=False)[0].vehicle == ("cav1",)
    assert measure_uplinks("ring", split_of("cav1"), settings, 40.0, 1)["ring/cav1"] == pytest.approx(610 / 35)
    with pytest.raises(InputError, match="no wireless rates of vehicle 'ring/cav0'; it has grid/cav0, cav1"):
        link_scenes(split_of("cav0"), SimpleNamespace(region="ring", poles=()), settings, 5, 1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"there is no file 'none.csv' in"):
        fix_throughput(NetworkSettings(throughput="none.csv"), table.parent)
    table.write_text(TABLE.replace("100,8", "100,9"), encoding="utf-8")
    with pytest.raises(InputError, match="the measured rates were changed"):
        link_scenes(split_of("cav0"), placed, settings, 5, 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("vehicle,time\na,1\n", "column 'mbps' is missing; .*; found vehicle, time_s"),
        ("vehicle,time,rate\n,1,2\n", "row 1: vehicle is empty"),
        ("vehicle,time,rate\na,1,-2\n", "row 1: mbps = -2 must be a number from 0 to"),
        ("vehicle,time,rate\na,1,fast\n", "row 1: mbps = 'fast' must be a number"),
        ("vehicle,time,rate\na,,2\n", "row 1: time_s = None must be a number"),
        ("vehicle,time,rate\na,1,2\na,1,3\n", "row 2: 'a' has another row of wireless at 1 s"),
        ("vehicle,time,rate,link\na,1,2,wifi\n", "row 1: link = 'wifi' must be wireless or wireline"),
        ("vehicle,time,rate,link\na,1,2,wireline\n", "has no wireless rates"),
        ("vehicle,time,rate\n", "has no wireless rates"),
    ],
)
def test_tables_that_cannot_be_used_are_refused_in_a_sentence(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "rates.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=f"rates.csv: {said}"):
        load_throughput(path)
