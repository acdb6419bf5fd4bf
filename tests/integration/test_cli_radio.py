"""`flcav radio` and `flcav rounds` on a small recording, from files to JSON, Parquet and pictures."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from flcav.cli.main import run
from flcav.network.clock.records import load_rounds

RECIPE = {
    **{"town": "suburb", "seed": 2, "warmup_s": 40.0, "spins_per_scene": 13, "every_s": 0.5, "cavs": 2, "poles": [3]},
    "vehicle_rig": {"lidars": {"lidar": {"mount": {"z": 1.8}, "settings": {"channels": 2, "azimuth_steps": 36}}}},
    "pole_rig": {"lidars": {"lidar": {"settings": {"channels": 2, "azimuth_steps": 36}}}},
}


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("radio")
    (folder / "drive.yaml").write_text(yaml.safe_dump(RECIPE))
    assert called("record", folder / "drive.yaml", "--out", folder / "drive", "--jobs", 1) == 0
    return folder / "drive"


def test_rates_at_the_recorded_pole_and_at_others(data, tmp_path, capsys):
    assert called("radio", data, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["scene"], told["town"], len(told["time_s"])) == ("suburb-2-000", "suburb", 13)
    assert [(link["vehicle"], link["unit"]) for link in told["links"]] == [("cav0", "pole3"), ("cav1", "pole3")]
    for link in told["links"]:
        assert len(link["rate_mbps"]) == len(link["distance_m"]) == len(link["state"]) == 13
        assert link["los"] + link["nlosv"] + link["nlos"] == pytest.approx(1)
        assert link["mean_mbps"] == pytest.approx(sum(link["rate_mbps"]) / 13)
        assert link["los"] == link["state"].count("LOS") / 13
    assert called("radio", data, "--pole", 1, "--pole", 3, "--pole", 1, "--json") == 0
    more = json.loads(capsys.readouterr().out)["links"]
    assert [link["unit"] for link in more] == ["pole1", "pole3"] * 2
    assert more[1::2] == told["links"]  # the same links, whatever other units there are
    assert called("radio", data, "--seed", 1, "--json") == 0
    assert json.loads(capsys.readouterr().out)["links"] != told["links"]
    assert called("radio", data, "--map", tmp_path / "map.png") == 0
    assert "cav0 at pole3: " in capsys.readouterr().out
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_rounds_as_text_table_and_picture(data, tmp_path, capsys):
    table, picture = tmp_path / "rounds.parquet", tmp_path / "rounds.png"
    asked = ("rounds", data, "--model-mb", 0.5, "--update-mb", 0.25, "--steps", 4, "--step-s", 0.05, "--step-s", 0.2)
    cloud = ("--rounds", 2, "--edge-rounds-per-cloud-round", 1)
    assert called(*asked, *cloud, "--out", table, "--timeline", picture, "--json") == 0
    told = json.loads(capsys.readouterr().out)["rounds"]
    records = load_rounds(table)
    assert [record["end_s"] for record in told] == [record.end_s for record in records]
    assert pq.read_table(table)["uploaded_bytes"].to_pylist() == [250_000] * 4
    assert pq.read_table(table)["downloaded_bytes"].to_pylist() == [500_000] * 4
    assert pq.read_table(table)["compute_s"].to_pylist() == pytest.approx([0.2, 0.8] * 2)
    assert records[0].wireline_down_s == records[0].wireline_up_s == pytest.approx(0.01 + 4e6 / 1e9)
    assert records[0].start_s == 40.0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert called(*asked) == 0
    assert "round 1: " in capsys.readouterr().out


def test_settings_of_the_network_are_read(data, tmp_path, capsys):
    settings = tmp_path / "network.yaml"
    settings.write_text("radio: {most_bps_hz: 0.5}\nrounds: {deadline_s: 0.1}\n")
    assert called("radio", data, "--network", settings, "--json") == 0
    rates = json.loads(capsys.readouterr().out)["links"][0]["rate_mbps"]
    assert max(rates) == 5
    assert called("rounds", data, "--network", settings, "--model-mb", 5) == 0
    told = capsys.readouterr().out
    assert "0 of 2 updates arrived, nobody's update arrived" in told
    assert told.count("dropped at 40.10 s, past the deadline") == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--pole", 9), "suburb: has no pole 9; its poles are 1, 2, 3, 4"),
        (("--scene", "other"), "no scene 'other'; the first is 'suburb-2-000'"),
        (("--network", "none.yaml"), "none.yaml: no such file"),
    ],
)
def test_bad_input_is_one_sentence(words, said, data, capsys):
    for command in (("radio",), ("rounds", "--model-mb", 1)):
        assert called(*command, data, *words) == 2
        told = capsys.readouterr().err
        assert said in told
        assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("radio: {bandwidth_mhz: 0}", "radio.bandwidth_mhz"),
        ("wireline: {rate_mbps: 0}", "wireline.rate_mbps"),
        ("rounds: {outage_s: -1}", "rounds.outage_s"),
        ("radio: {environment: indoor}", "radio.environment"),
    ],
)
def test_settings_without_sense_are_refused(settings, said, data, tmp_path, capsys):
    (tmp_path / "network.yaml").write_text(settings)
    assert called("radio", data, "--network", tmp_path / "network.yaml") == 2
    assert said in capsys.readouterr().err


def test_a_round_longer_than_the_trace_and_one_that_cannot_begin(data, capsys):
    assert called("rounds", data, "--model-mb", 1000, "--json") == 0
    clients = json.loads(capsys.readouterr().out)["rounds"][0]["clients"]
    assert {client["dropped"] for client in clients} == {"the trace ends"}
    assert called("rounds", data, "--model-mb", 1000, "--rounds", 2) == 2
    assert "round 2 begins at 46 s, but the trace is from 40 to 46 s" in capsys.readouterr().err
    assert called("rounds", data, "--model-mb", -1) == 2
