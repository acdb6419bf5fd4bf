"""`flcav place` from files to JSON."""

import json
from dataclasses import replace
from datetime import date
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure

from flcav.cli.main import run
from flcav.optimization.placement import solve
from flcav.planner import inputs as place_inputs
from flcav.report.charts import figures
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.map.town import Town, load_town
from flcav.world.sites import draw_sites

ERRORS = "x,y,z,weight\n0,0,0,1\n1,0,0,1\n50,0,0,5\n"
POLES = "id,x,y,z\n3,0,0,3\n8,50,0,3\n"


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


def at_random() -> dict[str, Any]:
    """What one of the two poles covers on average: 2 errors of the weight 1, or one of 5; about half of the draws."""
    return {"covered": pytest.approx(1.5, abs=0.1), "covered_weight": pytest.approx(3.5, abs=0.3)}


@pytest.fixture
def files(tmp_path) -> tuple[Path, Path]:
    (tmp_path / "errors.csv").write_text(ERRORS)
    (tmp_path / "poles.csv").write_text(POLES)
    return tmp_path / "errors.csv", tmp_path / "poles.csv"


def asked(files: tuple[Path, Path], *more: object, reach: object = 10, count: object = 1) -> int:
    return called("place", "--errors", files[0], "--poles", files[1], "--range", reach, "--count", count, *more)


@pytest.mark.parametrize("method", ["exact", "greedy"])
@pytest.mark.parametrize("parquet", [False, True])
def test_place_chooses_by_weight(files, method, parquet, capsys):
    if parquet:
        for path in files:
            pq.write_table(pyarrow.csv.read_csv(path), path.with_suffix(".parquet"))
        files = (files[0].with_suffix(".parquet"), files[1].with_suffix(".parquet"))
    assert asked(files, "--method", method, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "chosen": [{"pole": 8, "sensor": None}], "covered": 1, "covered_weight": 5.0, "upper_bound": 5.0,
        "optimal": True, "cost": None, "cost_lower_bound": None, "marginal_gain": [5.0],
        "certificate": {"values": [1.0, 1.0, 5.0], "price": pytest.approx(2), "bound": 5.0, "search": None},
        "baselines": {"visible-objects": None, "traffic-density": None, "random": at_random()},
    }  # fmt: skip
    assert asked(files) == 0
    assert "poles 8" in capsys.readouterr().out


@pytest.mark.parametrize("by", [1.0, 0.98])
def test_a_certificate_is_verified_and_one_that_does_not_hold_is_exit_1(files, by, capsys, monkeypatch):
    prove = solve.bound_by

    def claimed(*asked):
        found = prove(*asked)
        return replace(found, bound=by * found.bound)

    monkeypatch.setattr(solve, "bound_by", claimed)
    assert asked(files, "--verify") == (by < 1)
    told = capsys.readouterr().out
    assert "recomputed: 5 with 1 of the sensors; its dual alone proves 5, a gap of" in told
    assert ("does not hold: the dual's bound" in told) == (by < 1)
    assert asked(files, "--verify", "--json") == (by < 1)
    assert bool(json.loads(capsys.readouterr().out)["verification"]["faults"]) == (by < 1)


@pytest.mark.parametrize(
    ("limit", "told"),
    [
        (
            ("--cover", 1),
            "its dual alone proves 1.5; sums of the costs below 2 are at most 1, so that nothing better exists",
        ),
        (("--count", 1), "its dual alone proves 2, a gap of"),
    ],
)
def test_where_sums_are_whole_numbers_a_gap_is_not_told_beside_an_optimum(limit, told, files, capsys):
    """Each of three poles covers two of three points: fractions of poles cover all with one and a half."""
    files[0].write_text("x,y,z\n0,0,0\n10,0,0\n5,8,0\n")
    files[1].write_text("id,x,y,z\n1,5,0,0\n2,2.5,4,0\n3,7.5,4,0\n")
    assert called("place", "--errors", files[0], "--poles", files[1], "--range", 5.5, *limit, "--verify") == 0
    said = capsys.readouterr().out
    assert "(optimal)" in said
    assert told in said
    assert "the solver's word" not in said


@pytest.mark.parametrize(
    ("errors", "change", "named"),
    [
        ("x,kind\n0,0\n", {}, "column 'y' is missing; places are x, y [m] in the town, or latitude, longitude"),
        ("x,y,z\n0,nan,0\n", {}, "row 1: y ="),
        ("x,y,z\n", {}, "no rows"),
        (ERRORS, {"reach": -1}, "range = -1"),
        (ERRORS, {"reach": 0}, "range = 0"),
        (ERRORS.replace("weight", "gravity"), {}, "unknown column 'gravity'"),
        (ERRORS, {"count": 3}, "count = 3"),
        ("x,y,z,weight\n0,0,0,0\n1,0,0,0\n", {}, "every weight is 0"),
        ("x,y,z,severity,exposure\n0,0,0,1,1\n1,0,0,-1,-2\n", {}, "row 2: severity = -1 is below 0"),
    ],
)
def test_bad_input_is_one_sentence(errors, change, named, files, capsys):
    files[0].write_text(errors)
    assert asked(files, **change) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("ids", [[True, False], [1.5, 2.0], [[1], [2]], [b"a", b"b"], [date(2026, 1, 1)] * 2])
def test_ids_that_are_neither_text_nor_whole_are_one_sentence(ids, files, capsys):
    poles = files[1].with_suffix(".parquet")
    pq.write_table(pa.table({"id": ids, "x": [0.0, 50.0], "y": [0.0, 0.0], "z": [3.0, 3.0]}), poles)
    assert asked((files[0], poles), "--json") == 2
    err = capsys.readouterr().err
    assert "row 1: id = " in err
    assert "is neither text nor a whole number" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("written", "read"), [(("1", "02"), "02"), (("01", "1"), "1"), (("1", "8"), 8), (("1.0", "8.0"), "8.0")]
)
def test_ids_and_columns_of_a_csv_are_read_as_they_are_meant(written, read, files, capsys):
    files[1].write_text("\ufeffid, x, y, z\n{}, 0, 0, 3\n{}, 50, 0, 3\n".format(*written), encoding="utf-8")
    assert asked(files, "--json") == 0
    assert json.loads(capsys.readouterr().out)["chosen"] == [{"pole": read, "sensor": None}]


def test_traffic_of_another_town_is_refused(files, monkeypatch, capsys):
    class OfGrid:
        keys = ()

        def town(self) -> Town:
            return load_town("grid")

    monkeypatch.setattr(place_inputs.Dataset, "open", lambda folder: OfGrid())
    assert asked(files, "--data", "drive", "--town", "ring") == 2
    assert capsys.readouterr().err == "flcav: --town ring: the traffic of drive is that of grid\n"
    assert asked(files, "--data", "drive", "--town", "grid") == 0


SENSORS = "name,range_m,cost\nlong,100,9\nshort,10,2\n"


def priced(files: tuple[Path, Path], *more: object, poles: str = POLES, sensors: str = SENSORS) -> int:
    files[1].write_text(poles)
    files[1].with_name("sensors.csv").write_text(sensors)
    place = ("place", "--errors", files[0], "--poles", files[1], "--sensors", files[1].with_name("sensors.csv"))
    return called(*place, *more)


def test_sensors_and_poles_have_costs(files, capsys):
    poles = "id,x,y,z,cost\na,0,0,3,1\nb,50,0,3,1.5\n"
    for limit, chosen, cost in (
        (("--budget", 3), [("a", "short")], 3.0),
        (("--budget", 4), [("b", "short")], 3.5),
        (("--budget", 6.5), [("a", "short"), ("b", "short")], 6.5),
        (("--count", 1), [("a", "long")], 10.0),
        (("--cover", 0.5), [("b", "short")], 3.5),
        (("--cover", 0.2), [("a", "short")], 3.0),
    ):
        assert priced(files, *limit, "--json", poles=poles) == 0
        said = json.loads(capsys.readouterr().out)
        assert [(each["pole"], each["sensor"]) for each in said["chosen"]] == chosen
        assert (said["cost"], said["optimal"]) == (cost, True)
        assert said["cost_lower_bound"] == (cost if "--cover" in limit else None)
    assert priced(files, "--cover", 1, poles=poles) == 0
    assert "poles a (short), b (short)" in capsys.readouterr().out


def test_weights_are_multiplied_by_severity_exposure_and_class(files, capsys):
    files[0].write_text("x,y,z,severity,exposure,class\n0,0,0,3,.5,Car\n50,0,0,1,1,Pedestrian\n")
    for more, pole, weight in (((), 3, 1.5), (("--class-weight", "Pedestrian=4"), 8, 4.0)):
        assert asked(files, *more, "--json") == 0
        said = json.loads(capsys.readouterr().out)
        assert (said["chosen"][0]["pole"], said["covered_weight"]) == (pole, weight)


@pytest.mark.parametrize(
    ("more", "change", "named"),
    [
        (("--budget", 1), {}, "budget = 1"),
        (("--budget", 5, "--count", 1), {}, "one of the three"),
        (("--budget", 5, "--range", 9), {}, "one of the two"),
        (("--cover", 1.5), {}, "cover = 1.5"),
        (("--budget", 5), {"poles": "id,x,y,z\n3,0,0,3\n3,50,0,3\n"}, "two poles of the id 3"),
        (("--budget", 5), {"poles": "id,x,y,z,cost\n3,0,0,3,-1\n"}, "every cost"),
        (("--budget", 5), {"poles": "id,x,y,z\n3,0,0,3\n,50,0,3\n"}, "row 2 has no id"),
        (("--budget", 5), {"sensors": "name,range_m,cost\n,9,9\n"}, "row 1 has no name"),
        (("--budget", 5), {"sensors": "name,range_m,cost\nlong,9,9\n,9,8\n"}, "row 2 has no name"),
        (("--budget", 5), {"sensors": "name,range_m,cost\nlong,0,9\n"}, "range = 0"),
        (("--budget", 5), {"sensors": "name,range_m,cost\nlong,nan,9\n"}, "range_m = nan"),
        (("--budget", 5, "--line-of-sight"), {}, "--line-of-sight: needs"),
        (("--budget", 5, "--town", "suburb"), {"poles": "id,x,y,z\n3,900,0,3\n"}, "outside suburb"),
        (("--budget", 5, "--class-weight", "Car"), {}, "CLASS=FACTOR"),
    ],
)
def test_a_wrong_price_or_limit_is_one_sentence(more, change, named, files, capsys):
    assert priced(files, *more, **change) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


def test_the_map_tells_what_is_covered_what_was_bought_and_what_it_sees(tmp_path, monkeypatch, capsys):
    town = load_town("grid")
    at = [pole.tolist() for pole in town.poles.position[:2]]
    rows = [f"mast-{number},{x},{y},{z},{number}" for number, (x, y, z) in enumerate(at, start=1)]
    (tmp_path / "poles.csv").write_text("\n".join(["id,x,y,z,cost", *rows]))
    spots = [f"{x + 5},{y},{z}" for x, y, z in at] + [f"{at[0][0]},{at[0][1] + 200},1"]
    (tmp_path / "errors.csv").write_text("\n".join(["x,y,z", *spots]))
    (tmp_path / "sensors.csv").write_text("name,range_m,cost\ncamera,10,1\nlidar,20,9\n")
    drawn = []
    monkeypatch.setattr(figures, "town_map", lambda scene, width: drawn.append(scene) or Figure())
    files = [f"--{name}={tmp_path / name}.csv" for name in ("errors", "poles", "sensors")]
    assert called("place", *files, "--budget=5", "--town=grid", "--line-of-sight", f"--map={tmp_path / 'a.png'}") == 0
    assert "beyond every pole: 1 of your 3 points" in capsys.readouterr().out
    (scene,) = drawn
    assert scene.covered.tolist() == [True, True, False]
    assert set(scene.viewsheds) == {"1", "2"}
    assert scene.beyond.tolist() == [False, False, True]
    assert scene.notes[:2] == [
        "2 of your 3 points covered, cost 5",
        "camera, range 10 m, on poles mast-1 (1), mast-2 (2)",
    ]


HERE = load_town("suburb")
SPOTS = convert_to_geodetic(HERE.geo, np.array([[-60.0, 20.0, 0.0], [-62.0, 15.0, 0.0], [5.0, -5.0, 0.0]]))


def in_degrees(row: str, comma: str = ".") -> str:
    """The three spots as rows, in which LAT and LON are replaced."""
    rows = [row.replace("LAT", f"{lat:.7f}").replace("LON", f"{lon:.7f}") for lat, lon, _ in SPOTS.tolist()]
    return "".join(rows).replace(".", comma) if comma != "." else "".join(rows)


@pytest.mark.parametrize(
    ("written", "encoding", "unused"),
    [
        ("latitude;longitude\n" + in_degrees("LAT;LON\n", ","), "utf-8-sig", ""),
        ("Nr;Breite;Länge;Straße\n" + in_degrees("7;LAT;LON;Kö\n", ","), "cp1252", "; not used: Nr, Straße"),
        ("LONGITUD,LATITUDE,date\n" + in_degrees('LON,LAT,"May 1, 2024"\n'), "utf-8", "; not used: date"),
        ("start_lat\tstart_lng\tweight\n" + in_degrees("LAT\tLON\t1\n"), "utf-16", ""),
        ("Latitude (°),Longitude (°),x,y\n" + in_degrees("LAT,LON,500000,5400000\n"), "utf-8", "; not used: x, y"),
        ("X [m],Y [m]\n-60,20\n-62,15\n5,-5\n", "utf-8", ""),
    ],
)
def test_points_of_ones_own_are_taken_as_people_write_them(written, encoding, unused, tmp_path, capsys):
    table = tmp_path / "accidents.csv"
    table.write_bytes(written.encode(encoding))
    assert called("place", "--errors", table, "--range", 40, "--count", 1, "--town", "suburb") == 0
    out = capsys.readouterr().out
    by = "x and y" if "X [m]" in written else "latitude and longitude"
    assert f"accidents.csv: 3 points by {by}, on the ground of suburb{unused}\n" in out
    assert "candidates: the 4 poles of suburb\n" in out
    assert "pole 1: 2 points within 40 m, placed at x -65.4, y 17.7 m (latitude 49.000159, longitude" in out
    assert "cover 2 of your 3 points, weight 2 (optimal)" in out


def test_places_without_heights_are_on_the_slopes_and_poles_stand_above_them(tmp_path):
    town = load_town("hilly_suburb")
    (tmp_path / "points.csv").write_text("x,y\n-60,20\n5,-5\n")
    (tmp_path / "poles.csv").write_text("name,x,y,height_m\nA,-65,18,8\nB,5,-8,4.5\n")
    given = place_inputs.read_given(tmp_path / "points.csv", tmp_path / "poles.csv", None, 40.0, (), town=town)
    np.testing.assert_allclose(given.errors[:, 2], [town.ground(-60, 20), town.ground(5, -5)])
    np.testing.assert_allclose(given.poles[:, 2], [town.ground(-65, 18) + 8, town.ground(5, -8) + 4.5])
    assert np.ptp(given.errors[:, 2]) > 0.1
    (tmp_path / "poles.csv").write_text("lat,lon\n49,8.4\n")
    given = place_inputs.read_given(tmp_path / "points.csv", tmp_path / "poles.csv", None, 40.0, (), town=town)
    assert (given.ids, given.poles[0].tolist()) == ((1,), pytest.approx([0, 0, town.ground(0, 0) + 6], abs=1e-6))


@pytest.mark.parametrize(
    ("written", "more", "named"),
    [
        ("lat,lon\n49,8.4\n", (), "has latitude and longitude; give --town"),
        (
            "lat,lon\n49,8.4\n48.1,11.5\n48.2,11.5\n",
            ("--town", "suburb"),
            "row 2 lies at latitude 48.1, longitude 11.5",
        ),
        ("lat,lon\n49,8.4\n48.1,11.5\n48.2,11.5\n", ("--town", "suburb"), "; so do 2 of 3 rows"),
        ("lat,lon\n8.4,49\n", ("--town", "suburb"), "are latitude and longitude in each other's columns?"),
        ("lat,lon\n490001,8.4\n", ("--town", "suburb"), "row 1: latitude 490001, longitude 8.4 is no place on Earth"),
        ("lat,lon\n49,8.4\n,8.4\n", ("--town", "suburb"), "row 2: latitude is empty"),
        ("lat,lng\n49.00.1,8.4\n", ("--town", "suburb"), "row 1: latitude = '49.00.1' is not a finite number"),
        ("lat,x\n49,8.4\n", ("--town", "suburb"), "column 'longitude' is missing"),
        (
            "start_lat,end_lat,lon\n49,49,8\n",
            ("--town", "suburb"),
            "'start_lat' and 'end_lat' could both be the latitude",
        ),
        ("lat,lon,wieght\n49,8.4,2\n", ("--town", "suburb"), "unknown column 'wieght' (did you mean 'weight'?)"),
        ("x,y\n500000,5400000\n", ("--town", "suburb"), "row 1 lies at 500000, 5400000, far from suburb (x -162 to"),
        ("x,y\n0,0\n", (), "--poles: give a table of candidate sites, or --town"),
        ("x,y\n0,0\n", ("--town", "suburb", "--every", 2), "--every 2: must be from 5 to 1000 m"),
        ("x,y\n0,0\n", ("--town", "suburb", "--every", 25, "--poles", "p.csv"), "--poles and --every: one of the two"),
    ],
)
def test_places_that_are_none_are_one_sentence(written, more, named, tmp_path, capsys):
    (tmp_path / "points.csv").write_text(written)
    assert called("place", "--errors", tmp_path / "points.csv", "--range", 40, "--count", 1, *more) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


def test_a_parquet_table_with_a_column_twice_is_one_sentence(files, capsys):
    table = files[0].with_suffix(".parquet")
    pq.write_table(pa.table([[0.0], [0.0], [1.0]], names=["x", "y", "x"]), table)
    assert asked((table, files[1])) == 2
    assert "errors.parquet: column 'x' is there twice; found x, y, x\n" in capsys.readouterr().err


def test_the_curve_has_the_gain_of_each_further_sensor(tmp_path, capsys):
    random = np.random.default_rng(0)
    points = random.normal(0, 50, (60, 2))
    (tmp_path / "points.csv").write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in points))
    asked = ("place", "--errors", tmp_path / "points.csv", "--range", 40, "--town", "suburb", "--every", 60)
    assert called(*asked, "--count", 3, "--curve", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    sites = draw_sites(HERE, 60.0)
    near = ((np.c_[points, np.zeros(60)][None] - sites[:, None]) ** 2).sum(axis=2) <= 40**2
    best = [max(near[[*few]].any(axis=0).sum() for few in combinations(range(len(sites)), k)) for k in (1, 2, 3)]
    assert [each["covered_weight"] for each in told["curve"]] == best
    assert [each["gain"] for each in told["curve"]] == [best[0], best[1] - best[0], best[2] - best[1]]
    assert told["curve"][-1]["chosen"] == told["chosen"]
    at = [tuple(round(each[axis], 6) for axis in "xyz") for each in told["sites"]]
    assert at == [tuple(sites[each["pole"] - 1].round(6).tolist()) for each in told["chosen"]]
    assert called(*asked, "--count", 3, "--curve") == 0
    assert f"    2 sensors: weight {best[1]} (" in capsys.readouterr().out
    assert called(*asked, "--cover", 0.1, "--curve") == 2
    assert "--curve: needs --count" in capsys.readouterr().err
