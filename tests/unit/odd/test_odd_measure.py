"""Measurement by columns against the frames, and against the recorded traffic."""

from dataclasses import replace

import numpy as np
import pytest

from flcav.dataset.store import Dataset
from flcav.odd.measure import AROUND_M, _speeds, describe_weather, measure_domain, reach_of, summarise_measurements
from flcav.sensors.rig import RIGS, Rig


def test_counts_are_those_of_the_frames(drive: Dataset):
    found = measure_domain(drive)
    for row, i in zip(found.rows(), found.frames, strict=True):
        frame = drive.frame(i)
        away = np.linalg.norm(frame.annotations.boxes.center[:, :2] - frame.world_from_agent[:2, 3], axis=1)
        near = [
            (label, track)
            for label, track, distance in zip(frame.annotations.boxes.label, frame.annotations.track, away, strict=True)
            if distance <= AROUND_M and not track.startswith("parked")
        ]
        assert row["agents"] == len(near)
        assert row["pedestrians"] == sum(label == "pedestrian" for label, _ in near)
        assert frame.weather is not None
        assert row["visibility"] == frame.weather.visibility_m
        assert row["light"] == ("night" if frame.weather.night else "day")
    assert sum(row["agents"] or 0 for row in found.rows()) > 0  # type: ignore[misc]


def test_speeds_are_those_of_the_traffic(drive: Dataset):
    found = measure_domain(drive)
    for row, i in zip(found.rows(), found.frames, strict=True):
        key = drive.keys[i]
        trace = drive.trace(key.scene)
        assert trace is not None
        instant, actor = np.argmin(np.abs(trace.time_s - key.time_s)), list(trace.actor).index(key.agent)
        true = 3.6 * float(np.linalg.norm(trace.velocity[instant, actor]))
        assert row["ego_speed"] == pytest.approx(true, abs=6.0)  # km/h: the mean over half a second to either side


@pytest.mark.filterwarnings("error")
def test_frames_of_one_time_tell_no_speed(drive: Dataset, monkeypatch: pytest.MonkeyPatch):
    alike = [replace(key, time_s=0.5 * (key.index // 2)) for key in drive.keys]
    monkeypatch.setattr(drive, "keys", alike)
    found = _speeds(drive)
    assert np.isfinite(found[~np.isnan(found)]).all()
    assert not np.isnan(found).all()


def test_what_a_recording_does_not_say_is_missing():
    nothing = {name: np.array([np.nan]) for name in ("sun_elevation_deg", "wetness", "rain_mm_h", "visibility_m")}
    found = describe_weather(nothing | {"cloud_cover": np.array([np.nan])})
    assert found["light"].tolist() == [""]
    assert found["surface_condition"].tolist() == [""]
    assert np.isnan(found["rainfall"][0])


def test_the_sight_of_rigs():
    assert reach_of(RIGS["car"]) == {
        "field_of_view": 360.0,
        "sensing_range": RIGS["car"].lidars["lidar"].settings.range_m,
    }
    camera = RIGS["car"].cameras["camera"]
    alone = reach_of(Rig(cameras={"camera": camera}))
    assert alone["field_of_view"] == pytest.approx(camera.settings.fov_deg)
    assert np.isnan(alone["sensing_range"])


def test_a_span_says_what_is_there(drive: Dataset):
    spans = {span.attribute: span for span in summarise_measurements(measure_domain(drive))}
    assert spans["zone"].missing == len(measure_domain(drive))
    assert sum(spans["junction"].words.values()) == len(measure_domain(drive))
    low, high = spans["agents"].low, spans["agents"].high
    assert low is not None
    assert high is not None
    assert low <= high
