"""Labels from tracks of a recorded drive: of what vehicles record alone, and read back as they were written."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.dataset.ground import DatasetGround
from flcav.fusion.average import NavigationErrors
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes
from flcav.interface.progress import ignore_progress
from flcav.network.awareness import MessageSettings, draw_connected
from flcav.network.radio.budget import Radio
from flcav.perception.metrics import match
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import asked_of, in_range
from flcav.perception.weights import find_shipped, load_network
from flcav.runs.frames import Frames, list_window, record_frames
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.labels.heard import hear_messages
from flcav.runs.labels.pseudo_labels import EXACT, label_frames
from flcav.runs.labels.tracks import label_tracked, load_heard, load_tracks, save_tracks, track_frame
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.tracking import check_windows
from flcav.sources.recipe import Recipe
from flcav.world.trace import Trace

CLOSE = MessageSettings(share=0.9, position_m=0.1, radio=Radio(power_dbm=60))  # no vehicle in its way blocks a message
DRIVE = {"town": "suburb", "seed": 5, "scenes": 2, "spins_per_scene": 1, "cavs": 2, "warmup_s": 40.0, "window_s": 0.6}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    recipe = Recipe.model_validate(DRIVE | {"window_every_s": 0.2, "poles": [1]})
    record_frames(recipe, folder, folder, ignore_progress).save(folder)
    return folder


@pytest.fixture(scope="module")
def network():
    return load_network(OBJECTS, find_shipped(OBJECTS))


@pytest.mark.slow
def test_tracks_find_more_than_one_sweep_does_and_fit_better(folder: Path, network) -> None:
    split = Frames.open(folder)
    assert [len(list_window(split, (i,), 1.0)) for i in split.vehicles] == [7] * 4
    frames = [split.data.frame(i) for i in split.vehicles]
    truths = [asked_of(frame, network.config) for frame in frames]
    tracks = [track_frame(network, split, i) for i in split.vehicles]
    single = detect_in(network, frames, score_threshold=0.1)
    hits = {}
    for name, found in (("tracks", tracks), ("single", single)):
        cars = [boxes[(boxes.label == "Car") & in_range(boxes, network.config)] for boxes in found]
        targets = [truth.targets[truth.targets.label == "Car"] for truth in truths]
        hits[name] = int(match(cars, targets, [truth.neutral for truth in truths], 0.7).hit.sum())
    assert hits["tracks"] >= hits["single"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("labels", ["tracks", "messages", "tracks+messages"])
def test_no_annotation_has_a_part_in_a_label(folder: Path, network, tmp_path: Path, labels: str) -> None:
    """Scrambled annotations give the same bytes of tracks and of samples; so does traffic that sends nothing."""
    kind = LABEL_SOURCES[labels]
    scrambled = tmp_path / "scrambled"
    shutil.copytree(folder, scrambled)
    path = scrambled / "data" / "annotations.parquet"
    table = pq.read_table(path)
    rng = np.random.default_rng(0)
    for name in ("x", "y", "length", "yaw"):
        place = table.schema.get_field_index(name)
        drawn = pa.array(rng.uniform(0.5, 9, len(table))).cast(table.schema.field(name).type)
        table = table.set_column(place, table.schema.field(name), drawn)
    pq.write_table(table, path)
    scramble_silent(scrambled)
    kept = []
    for where in (folder, scrambled):
        split = Frames.open(where)
        heard = {i: hear_messages(split, i, CLOSE, network) for i in split.vehicles if kind.heard}
        frames = [i for i, own in heard.items() if len(own.announced.senders)][:1] or split.vehicles[:2]
        heard = {i: heard[i] for i in frames if kind.heard}
        assert len(heard) == kind.heard
        told = {i: own.announced for i, own in heard.items()}
        tracks = {i: track_frame(network, split, i, (), EXACT, told.get(i), kind.from_detections) for i in frames}
        ground = None if kind.from_detections else DatasetGround(split.data)
        about = (split, frames, (), "suburb", ignore_progress)
        samples = label_frames(label_tracked(tracks, 0.3, network.config, ground), *about)
        out = tmp_path / where.name
        out.mkdir(exist_ok=True)
        save_tracks(tracks, out, {i: own.bytes for i, own in heard.items()})
        assert load_heard(out) == {i: own.bytes for i, own in heard.items()}
        read = load_tracks(out)
        for i, own in tracks.items():
            np.testing.assert_array_equal(read[i].array(), own.array())
            assert read[i].score == pytest.approx(own.score)
            assert read[i].label.tolist() == own.label.tolist()
        parts = [(out / "tracks.msgpack").read_bytes()]
        for own in (each for name in sorted(samples) for each in samples[name]):
            parts += [own.boxes.array().tobytes(), own.ignore.array().tobytes(), own.points.tobytes()]
        kept.append(parts)
    assert kept[0] == kept[1]
    assert Frames.open(scrambled).data.frame(0).annotations.boxes.center[0, 0] != pytest.approx(
        Frames.open(folder).data.frame(0).annotations.boxes.center[0, 0]
    )


def scramble_silent(folder: Path) -> None:
    """Move all traffic that neither records nor sends a message, other than far."""
    for path in (folder / "data" / "traces").glob("*.parquet"):
        trace = Trace.load(path)
        silent = np.ones(len(trace.actor), np.bool_)
        silent[draw_connected(trace, CLOSE, str(DRIVE["seed"]), path.stem)] = False
        silent &= ~np.char.startswith(trace.actor, "cav")
        assert silent.sum() > 20
        replace(trace, position=trace.position + silent[:, None] * 7.0).save(path)


def test_poses_are_those_of_the_navigation(folder: Path, network) -> None:
    split = Frames.open(folder)
    i = split.vehicles[0]
    exact, off = (
        track_frame(network, split, i, (), NavigationErrors(position_m=error, heading_deg=error)) for error in (0, 1)
    )
    assert len(exact)
    assert not np.array_equal(exact.array()[:1], off.array()[:1])
    again = track_frame(network, split, i, (), NavigationErrors(position_m=1, heading_deg=1))
    np.testing.assert_array_equal(off.array(), again.array())


def test_tracks_below_the_threshold_and_lookalikes_of_the_road_are_ignored(folder: Path, network) -> None:
    split = Frames.open(folder)
    i = split.vehicles[0]
    tracks = track_frame(network, split, i)
    assert tracks.score is not None
    cut = float(np.median(tracks.score))
    (sample,) = label_frames(
        label_tracked({i: tracks}, cut, network.config), split, (i,), (), "suburb", ignore_progress
    )["suburb/cav0"]
    assert 0 < len(sample.boxes) <= int((tracks.score >= cut).sum())
    assert len(sample.boxes) + len(sample.ignore) == len(tracks)
    assert sample.exact is None
    assert sample.free is None
    (none,) = label_frames(label_tracked({i: tracks}, 2.0, network.config), split, (i,), (), "suburb", ignore_progress)[
        "suburb/cav0"
    ]
    assert (len(none.boxes), len(none.ignore)) == (0, len(tracks))


def test_boxes_of_a_pole_join_the_tracks_by_its_classes(folder: Path, network) -> None:
    split = Frames.open(folder)
    i = split.vehicles[0]
    far = split.data.frame(i).world_from_agent[:3, 3] + (15.0, 0.0, 0.8)
    boxes = Boxes.from_array(
        np.array([(*far, 4.4, 1.8, 1.6, 0.0), (far[0] + 40, *far[1:], 4.4, 1.8, 1.6, 0.0)]), ["car", "truck"]
    )
    view = RoadView(boxes, np.zeros(2), np.zeros((1, 1), bool), np.zeros((1, 1), bool))
    alone, joined = (track_frame(network, split, i, views) for views in ((), (view,)))
    assert joined.score is not None
    told = np.hypot(joined.center[:, 0] - 15.0, joined.center[:, 1]) < 0.1
    assert told.sum() == len(joined) - len(alone) == 1  # the truck is none of the network's classes
    assert joined.score[told].item() == 0  # nothing returns there: it is ignored
    np.testing.assert_array_equal(joined.score[~told], alone.score)
    assert replace(joined, score=None).label.tolist().count("truck") == 0


def test_sweeps_that_stand_alone_are_refused_in_a_sentence() -> None:
    def split(*times: tuple[str, float]) -> Frames:
        keys = [SimpleNamespace(scene=scene, agent="ego", time_s=time_s) for scene, time_s in times]
        return Frames(cast(Any, SimpleNamespace(keys=keys)), tuple(range(len(keys))), {})

    check_windows(split(("a", 0.0), ("a", 0.5), ("b", 0.0)), (0, 1, 2), "real")  # one of three stands alone
    check_windows(split(), (), "real")
    for times in ((("a", 0.0), ("b", 0.0)), (("a", 0.0), ("a", 1.5))):
        with pytest.raises(InputError, match=r"^real: labels by tracks need sweeps within 1 s of one another"):
            check_windows(split(*times), (0, 1), "real")


def test_where_nobody_sends_there_are_no_labels_by_messages(folder: Path, network) -> None:
    split = Frames.open(folder)
    heard = hear_messages(split, split.vehicles[0], MessageSettings(share=0), network)
    assert (heard.count, heard.bytes, len(heard.announced.senders), heard.announced.perceived) == (0, 0, 0, ())
    assert len(track_frame(network, split, split.vehicles[0], (), EXACT, heard.announced, detects=False)) == 0


def test_messages_need_the_traffic_of_a_town(folder: Path, network, tmp_path: Path) -> None:
    """In the step, and before the run where the region is recorded data."""
    bare = tmp_path / "bare"
    shutil.copytree(folder, bare)
    for path in (bare / "data" / "traces").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"bare/data: labels by messages need the traffic of a simulated town"):
        hear_messages(Frames.open(bare), 0, CLOSE, network)

    def outline(where: Path) -> Outline:
        split = dict.fromkeys(("validation", "registry", "edge", "test"), str(where / "data"))
        fields = {
            "tasks": {"objects": {"labels": "messages", "plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 0}}},
            "regions": {"suburb": {"role": "pretrain"}, "real": {"role": "federate", "data": split}},
            "budgets_mb": {"wireless": 100, "wireline": 80},
        }
        return Outline(RunRecipe.model_validate(fields), tmp_path)

    assert outline(folder).recorded["real"].keys() == {"cav0", "cav1"}
    with pytest.raises(InputError, match=r"labels by messages need the traffic .* 'suburb-5-000' has none"):
        outline(bare)
