"""Regions of real vehicles from made folders, and what is concluded from the networks' differences."""

import csv
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from flcav.config import InputError
from flcav.experiments.experiment import Options
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.optimization.curves.history import load_history
from flcav.perception.errors import PerceptionError
from flcav.reproductions.real import networks
from flcav.reproductions.real import run as real
from flcav.reproductions.real.curve import SIZES, LearningCurve, Planned, fit_points
from flcav.reproductions.real.drive import ASIDE_M, EVERY_M, HEIGHT_M, DriveErrors, count_errors, line_poles
from flcav.reproductions.real.fleet import Vehicle, sum_bytes
from flcav.reproductions.real.networks import ANNOTATED, PRETRAINED
from flcav.reproductions.real.regions import (
    ASTYX,
    CHOSE,
    EDGE,
    KARLSRUHE,
    TEST,
    VALIDATION,
    Sweep,
    convert_labels,
    cut_aside,
    list_astyx,
    list_drive,
    list_karlsruhe,
    read_drive,
    share_scenes,
    write_kitti,
    write_tracking,
)
from flcav.runs.provenance import provenance
from flcav.runs.recipe import load_run_recipe
from flcav.runs.results.training import LabelQuality
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import mean_over_seeds
from flcav.statistics.verdicts import judge

CALIB = "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
POINTS = np.array([[10, 0, -1, 0.5], [10, 8, -1, 0.5], [10, -9, -1, 0.5], [-5, 0, -1, 0.5]], np.float32)
CAR = "0 0 -1.6 560 160 640 220 1.5 1.7 4.0 0 1.6 20 -1.57"
T = TypeVar("T")


def lay_out(folder: Path, numbers: list[str]) -> Path:
    """Write sweeps with a labelled car in KITTI's object layout."""
    for kind, end, content in (("velodyne", "bin", POINTS.tobytes()), ("calib", "txt", CALIB.encode())):
        (folder / "training" / kind).mkdir(parents=True, exist_ok=True)
        for number in numbers:
            (folder / "training" / kind / f"{number}.{end}").write_bytes(content)
    (folder / "training/label_2").mkdir(exist_ok=True)
    for number in numbers:
        (folder / f"training/label_2/{number}.txt").write_text(f"Car {CAR}\n")
    return folder


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Return the folder of a tracking sequence of ten sweeps, whose second one has no label."""
    part = tmp_path / "kitti_tracking_0000/training"
    for kind in ("velodyne/0000", "label_02", "calib"):
        (part / kind).mkdir(parents=True)
    for frame in range(10):
        POINTS.tofile(part / f"velodyne/0000/{frame:06d}.bin")
    (part / "label_02/0000.txt").write_text("".join(f"{frame} 7 Car {CAR}\n" for frame in range(10) if frame != 1))
    (part / "calib/0000.txt").write_text(CALIB)
    return part.parent


def test_labels_of_a_sequence_become_those_of_single_frames() -> None:
    texts = convert_labels([f"0 3 Person 2 {CAR[2:]}", f"0 4 Car 1 {CAR[2:]}", f"12 3 Car 0 {CAR[2:]}"])
    assert texts == {0: f"Person_sitting 0.75 {CAR[2:]}\nCar 0.25 {CAR[2:]}\n", 12: f"Car 0.00 {CAR[2:]}\n"}


def test_points_beside_the_image_are_cut() -> None:
    assert cut_aside(POINTS).tolist() == POINTS[[0, 1]].tolist()  # 0 and 39 degrees, not -42 and 180


def test_a_drive_is_shared_in_stretches(drive: Path) -> None:
    sweeps = list_drive(read_drive(drive))
    assert [each.number for each in sweeps] == [f"{n:06d}" for n in range(10)]
    assert [each.vehicle for each in sweeps] == [each.scene for each in sweeps] == [0, 0, 0, 1, 1, 1, 2, 2, 3, 3]
    assert [each.index for each in sweeps] == [0, 1, 2, 0, 1, 2, 0, 1, 0, 1]
    assert [each.time_s for each in sweeps[:3]] == pytest.approx([0, 0.1, 0.2])
    assert (sweeps[0].labels, sweeps[1].labels) == (f"Car 0.00 {CAR[2:]}\n", "")


def test_packed_points_are_the_drive_too(drive: Path, tmp_path: Path) -> None:
    packed = tmp_path / "packed"
    packed.mkdir()
    cm, level = (POINTS[:, :3] * 100).astype(np.int16), (POINTS[:, 3] * 255).astype(np.uint8)
    np.savez(packed / "points.npz", **{"000004_xyz_cm": cm, "000004_intensity_255": level})
    (packed / "label_02.txt").write_text(f"4 7 Car {CAR}\n")
    (packed / "calib.txt").write_text(CALIB)
    (sweep,) = list_drive(read_drive(packed))
    assert (sweep.number, sweep.labels) == ("000004", f"Car 0.00 {CAR[2:]}\n")
    assert isinstance(sweep.points, np.ndarray)
    np.testing.assert_allclose(sweep.points, POINTS[:2], atol=0.005)
    write_tracking(read_drive(packed), tmp_path / "out")
    again = read_drive(tmp_path / "out")
    np.testing.assert_array_equal(again.sweeps[4], sweep.points)
    assert again.labels.read_text() == f"4 7 Car {CAR}\n"


def test_scenes_follow_from_times_and_are_not_split_among_vehicles(tmp_path: Path) -> None:
    numbers = [f"{n:06d}" for n in (5, 100, 101, 102, 103, 104, 230, 231)]
    lay_out(tmp_path / "astyx", numbers)
    times = [0, 10, 11, 16, 17, 40, 50, 53.5]  # gaps of more than 3 s begin a scene
    rows = [f"{number},{round(at * 1e6)}" for number, at in zip(numbers, times, strict=True)]
    (tmp_path / "astyx/timestamps.csv").write_text("\n".join(("frame,lidar_us", *rows)))
    splits = list_astyx([tmp_path])
    assert {name: [each.number for each in split] for name, split in splits.items()} == {
        EDGE: numbers[1:6],
        VALIDATION: numbers[:1],
        TEST: numbers[6:],
    }
    assert [(each.scene, each.index, each.time_s) for each in splits[EDGE]] == [
        (0, 0, 0.0),
        (0, 1, 1.0),
        (1, 0, 0.0),
        (1, 1, 1.0),
        (2, 0, 0.0),
    ]
    assert [each.scene for each in splits[TEST]] == [0, 1]
    vehicles = {(each.scene, each.vehicle) for each in splits[EDGE]}
    assert len(vehicles) == 3  # a vehicle per scene
    (tmp_path / "astyx/timestamps.csv").write_text("number,us\n000005,1\n")
    with pytest.raises(InputError, match=r"timestamps\.csv: wanted are the columns frame, lidar_us"):
        list_astyx([tmp_path])


def test_vehicles_have_about_as_many_sweeps() -> None:
    scenes = [0] * 4 + [1] * 2 + [2] * 2 + [3] * 4 + [4] * 4
    sweeps = [Sweep(str(n), POINTS, Path(), "", scene=scene) for n, scene in enumerate(scenes)]
    assert [each.vehicle for each in share_scenes(sweeps, 4)] == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4


def test_frames_that_chose_the_detector_are_no_test_frames(drive: Path, tmp_path: Path) -> None:
    lay_out(tmp_path / "kitti", [*CHOSE[:2], "000008"])
    splits = list_karlsruhe([tmp_path])
    assert [each.number for each in splits[VALIDATION]] == [*CHOSE[:2]]
    assert [(each.number, each.scene) for each in splits[TEST]] == [("000008", 0)]
    assert len(splits[EDGE]) == 10
    assert all(isinstance(each.points, np.ndarray) and len(each.points) == 2 for each in splits[VALIDATION])


def test_frames_that_lie_elsewhere_take_the_place_of_the_test_frames(drive: Path, tmp_path: Path) -> None:
    lay_out(tmp_path / "kitti", [*CHOSE[:1], "000008"])
    lay_out(tmp_path / "more/kitti", ["000010", "000011"])
    splits = list_karlsruhe([tmp_path / "more", tmp_path])
    assert [each.number for each in splits[TEST]] == ["000010", "000011"]
    assert [each.number for each in splits[VALIDATION]] == [CHOSE[0]]
    with pytest.raises(InputError, match=r"astyx: no sweep that is wanted in training/velodyne"):
        list_astyx([tmp_path])


def test_a_region_is_written_in_kittis_layout(tmp_path: Path) -> None:
    (one,) = (lay_out(tmp_path / "in", ["000100"]) / "training/velodyne").iterdir()
    calib = one.parents[1] / "calib/000100.txt"
    label = one.parents[1] / "label_2/000100.txt"
    sweeps = [
        Sweep("000100", one, calib, label, scene=3, index=1, vehicle=2, time_s=1.25),
        Sweep("000101", POINTS, calib, "Car\n", scene=3, index=2, vehicle=2, time_s=1.5),
    ]
    write_kitti(sweeps, tmp_path / "out")
    with (tmp_path / "out/frames.csv").open() as file:
        rows = [*csv.DictReader(file)]
    assert [(row["number"], row["frame"], row["agent"], float(row["time_s"])) for row in rows] == [
        ("000100", "stretch003_000001_car2", "car2", 1.25),
        ("000101", "stretch003_000002_car2", "car2", 1.5),
    ]
    linked, written = (tmp_path / f"out/training/velodyne/00010{n}.bin" for n in (0, 1))
    assert linked.is_symlink()
    assert linked.read_bytes() == one.read_bytes()
    assert written.read_bytes() == POINTS.tobytes()
    assert (tmp_path / "out/training/label_2/000101.txt").read_text() == "Car\n"


def test_candidates_stand_on_both_sides_of_the_way() -> None:
    still = np.repeat([[0.0, 0.0, 1.0]], 5, axis=0) + np.random.default_rng(0).normal(0, 0.02, (5, 3)) * [1, 1, 0]
    way = np.concatenate((still, np.column_stack((np.arange(1.5, 45), np.zeros(44), np.ones(44)))))
    poles = line_poles(way)
    assert len(poles) == 2 * 3
    np.testing.assert_allclose(
        poles[2:4], [[EVERY_M, ASIDE_M, 1 + HEIGHT_M], [EVERY_M, -ASIDE_M, 1 + HEIGHT_M]], atol=0.1
    )


def test_errors_are_counted_by_kind_and_class() -> None:
    one = PerceptionError(0, 0, 0, 1, "miss", "Car", 9, 0.0, "drive", "7")
    assert count_errors([one, replace(one, kind="false_positive"), one]) == {"false_positive Car": 1, "miss Car": 2}


def test_bytes_are_those_of_a_vehicle_by_radio() -> None:
    book = Ledger(LinkMegabytes(1, 1))
    book.enter(LedgerEntry("edge", "objects", "wireless", "up", 1, "astyx/car0", 100))
    book.enter(LedgerEntry("edge", "objects", "wireless", "up", 1, "stretch003/car0", 10))
    book.enter(LedgerEntry("edge", "objects", "wireless", "down", 1, "astyx/car0", 5))
    book.enter(LedgerEntry("edge", "objects", "wireline", "up", 1, "astyx", 1000))
    assert sum_bytes(book) == {("car0", "up"): 110, ("car0", "down"): 5}


def test_a_plan_buys_the_sweeps_that_its_budget_holds(tmp_path: Path) -> None:
    points = {str(size): (1 - 1.5 * size**-0.5,) * 2 for size in SIZES}
    curve = fit_points(0.3, points, sweep_mb=0.05, history=tmp_path / "history.csv")
    assert (curve.a, curve.b, curve.floor) == pytest.approx((1.5, 0.5, 0.0), abs=0.01)
    small, large = curve.plans
    assert small.sweeps == 20
    assert large.sweeps == 60
    assert small.predicted == pytest.approx(1 - 1.5 * 20**-0.5, abs=0.01)
    assert len(load_history(tmp_path / "history.csv").accuracy) == 2 * len(SIZES)


def test_without_data_it_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = (lambda _: nullcontext(print), lambda _: nullcontext(print))
    options = Options("real", 1, False, 1, "processes", "refuse", *shown)
    monkeypatch.delenv(real.DATA, raising=False)
    with pytest.raises(InputError, match="reproduce real: needs FLCAV_REAL_DATA"):
        real.find_data(options)
    monkeypatch.setenv(real.DATA, "data")
    assert real.find_data(options) == [Path("data/real")]
    assert real.find_data(replace(options, data=Path("more"))) == [Path("more"), Path("data/real")]


@pytest.fixture
def results() -> real.RealResult:
    """Return made results, in which every later network is 0.1 AP50 better than the one before."""

    def of(region: str, value: Callable[[str, str], T]) -> dict[str, T]:
        left_out = {real.TRACKS} if region == ASTYX else set[str]()
        return {f"{a} - {b}": value(a, b) for a, b in real.COMPARED if not {a, b} & left_out}

    reached = real.Reached(Estimate(0.4, 0.3, 0.5), cars=0.5, found=12.0, false=9.0, targets=20, trainings=5)
    return real.RealResult(
        splits={region: {TEST: real.Split(9, 9, 1)} for region in (KARLSRUHE, ASTYX)},
        reached={region: dict.fromkeys(real.NETWORKS, reached) for region in (KARLSRUHE, ASTYX)},
        differences={
            region: of(region, lambda after, before: mean_over_seeds([0.09, 0.11])) for region in (KARLSRUHE, ASTYX)
        },
        labels=LabelQuality(1, 10, 20, 0.9, None),
        vehicles=(Vehicle(ASTYX, "car0", 30, 70, 1.5, 1.25, 12.0, 0.75),),
        drive=DriveErrors(154, 71.4, {"false_positive Car": 2, "miss Car": 1}, 8, ((6,), (2, 6)), (2, 3), True),
        curve=LearningCurve(
            0.34, {"8": (0.3, 0.2), "15": (0.4, 0.35)}, 1.0, 0.2, 0.0, 0.02, (), (Planned(1.0, 9, 0.3),)
        ),
        recipe={},
        provenance=provenance(1),
    )


def with_gains(results: real.RealResult, gains: list[float]) -> real.RealResult:
    """Return results with these gains of annotated labels on Astyx, by training."""
    found = {**results.differences[ASTYX], f"{ANNOTATED} - {PRETRAINED}": mean_over_seeds(gains)}
    return replace(results, differences={**results.differences, ASTYX: found})


@pytest.mark.parametrize(
    ("gains", "verdict"),
    [
        ([0.28, 0.30, 0.29, 0.31, 0.30], "held"),
        ([0.10, 0.12, 0.11, 0.09, 0.1], "did not hold"),
        ([0.1, 0.3], "undecided"),
    ],
)
def test_the_claim_is_a_gain_of_a_fifth(results: real.RealResult, gains: list[float], verdict: str) -> None:
    (claim,) = with_gains(results, gains).claims().values()
    assert (claim.than, claim.mean.mean) == (0.20, pytest.approx(np.mean(gains)))
    assert judge([claim])[0].verdict == verdict


def test_expectations_are_compared_with_what_came(results: real.RealResult) -> None:
    about = (ASTYX, ANNOTATED, PRETRAINED)
    low, high = real.EXPECTED[about]
    for came, right in ((low + 0.001, True), (low - 0.001, False), (high + 0.001, False)):
        expected = with_gains(results, [came, came]).expectations()
        assert expected[about].came == pytest.approx(came)
        assert expected[about].right == right
    assert {*expected} == {*real.EXPECTED}


def test_tables_have_rates_by_frame_and_shares(results: real.RealResult) -> None:
    tables = real.tabulate_real(results)
    assert (
        "| astyx | edge FL on annotated labels | 5 | 0.400 (0.300 to 0.500) | 0.500 | 12.0 of 20 | 1.00 |"
        in tables["networks"]
    )
    assert tables["labels"].endswith("| 0.900 | - |")
    assert "| astyx/car0 | 30 | 70 | 1.50 | 1.25 | 12 | 0.75 |" in tables["vehicles"]
    assert "| 2 | 2, 6 | 3 of 3 |" in tables["poles"]
    assert "| false_positive | Car | 2 |" in tables["errors"]
    assert results == real.RealResult.from_json(results.as_json(), "made")


def test_the_recipe_has_what_the_expectations_are_about() -> None:
    recipe = load_run_recipe(real.RECIPE)
    assert {arm for arm, _ in networks.OF_RUN.values()} == {"main", *recipe.arms}
    assert recipe.with_role("federate") == (KARLSRUHE, ASTYX)
    assert (recipe.retrainings, recipe.retrain_from, recipe.tasks["objects"].weights) == (4, "edge", "packaged")
    assert not recipe.tasks["objects"].pretrains  # no sweep, real or not, is trained on before the federation
    assert {(after, before) for _, after, before in real.EXPECTED} <= {*real.COMPARED}
