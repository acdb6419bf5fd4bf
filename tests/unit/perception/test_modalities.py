"""A radar's echoes and painted points beside a sweep: geometry, statistics, messages, failures, speeds."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from flcav.config import InputError
from flcav.geometry import Boxes, concatenate, pose, unit_vectors
from flcav.perception.objects import modalities
from flcav.perception.objects.augment import augment
from flcav.perception.objects.config import CONFIGURATIONS, ECHO, PAINT_CLASSES, Augmentation
from flcav.perception.objects.loss import SPEED_WEIGHT, assign_anchors, second_loss, speed_loss
from flcav.perception.objects.modalities import blind, estimate_velocity, place_echoes, read_cloud, widen
from flcav.perception.objects.model import SPEED_M_S, HeadOutput, second
from flcav.perception.objects.painter import classes_of, new_painter, paint
from flcav.perception.objects.predict import detect_all, voxels_of
from flcav.perception.objects.samples import Sample, compress_sample, pack_sample, unpack_sample
from flcav.perception.objects.truth import FrameTruth, ground_truth
from flcav.perception.objects.velocities import (
    LateFusion,
    find_echoes,
    fit_late_fusion,
    fuse_late,
    list_velocity_errors,
    measure_velocities,
    take_speeds,
)
from flcav.perception.ops.grids import pillar_means
from flcav.perception.road.model import STRIDE
from flcav.sensors.frame import SEMANTICS, Calibration, CameraImage, Frame

from .frames import frame

RADAR, PAINTED = CONFIGURATIONS["pillars_radar"], CONFIGURATIONS["pillars_painted"]
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # vehicle from a camera ahead


def echoes_of(velocity: np.ndarray, count: int = 200, moving: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (N, 3) and range rates (N,) of a radar that moves; a share of the echoes moves, too."""
    rng = np.random.default_rng(3)
    ahead = unit_vectors(rng.uniform(-1, 1, count), rng.uniform(-0.05, 0.05, count))
    rate = -ahead @ velocity + 0.05 * rng.standard_normal(count)
    movers = rng.random(count) < moving
    return ahead, rate + np.where(movers, rng.uniform(3, 15, count), 0.0)


@pytest.mark.parametrize("velocity", [(12.0, 0.0), (0.0, 0.0), (-3.0, 0.0), (8.0, 0.6)])
def test_the_own_velocity_is_that_by_which_most_echoes_stand(velocity: tuple[float, float]) -> None:
    true = np.array([*velocity, 0.0])
    found = estimate_velocity(*echoes_of(true))
    np.testing.assert_allclose(found, true, atol=0.08)
    assert (estimate_velocity(*(each[:5] for each in echoes_of(true))) == 0).all()


def with_radar(echoes: np.ndarray) -> Frame:
    """Return a frame with a radar .5 m above the ground, 2 m ahead of the origin and turned to the left by .5 rad."""
    plain = frame([("a", "car", 20.0, 4.0, 0)], points=np.array([[5.0, 0, -1.8, 0.4]], np.float32))
    mounts = Calibration({**plain.assumed.agent_from_sensor, "radar": pose(2, 0, 0.5, 0.5)})
    annotations = replace(plain.annotations, points={"radar": np.array([6])})
    return replace(
        plain, calibration=mounts, assumed=mounts, radar={"radar": echoes.astype(np.float32)}, annotations=annotations
    )


def test_echoes_are_where_they_are_with_their_speed_over_ground() -> None:
    ahead, rate = echoes_of(np.array([10.0, 0.0, 0.0]), moving=0.0)
    azimuth, elevation = np.arctan2(ahead[:, 1], ahead[:, 0]), np.arcsin(ahead[:, 2])
    values = np.column_stack((np.full(len(rate), 20.0), azimuth, elevation, rate, np.full(len(rate), 3.0)))
    values[0] = (10.0, 0.0, 0.0, -10.0 + 7.0, 12.0)  # an object that moves away by 7 m/s
    made = place_echoes(with_radar(values), "top")
    x, y = 2 + 10 * np.cos(0.5), 10 * np.sin(0.5)  # of the vehicle's frame; the LiDAR is 1.8 m above its origin
    np.testing.assert_allclose(made[0], (x, y, 0.5 - 1.8, ECHO, 7.0, 12.0), atol=0.03)
    assert np.abs(made[1:, 4]).max() < 0.3
    cloud = read_cloud(with_radar(values), RADAR)
    assert cloud.shape == (1 + len(rate), 6)
    np.testing.assert_array_equal(cloud[0], np.array([5, 0, -1.8, 0.4, 0, 0], np.float32))


def test_an_echo_counts_as_a_return_of_a_network_that_reads_the_radar() -> None:
    seen = with_radar(np.zeros((0, 5)))
    assert ground_truth(seen, RADAR).target.tolist() == [True]
    assert ground_truth(seen, CONFIGURATIONS["pillars_far"]).target.tolist() == [False]


def test_means_of_pillars_are_those_of_a_loop() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform((0, -2, -2, 0), (4, 2, 0, 1), (60, 4)).astype(np.float32)
    values, sample = rng.normal(size=(60, 2)).astype(np.float32), rng.integers(0, 2, 60)
    tensors = [torch.from_numpy(each) for each in (points, values, sample)]
    found = pillar_means(tensors[0], tensors[1], tensors[2], 2, (0, -2, -3, 4, 2, 1), (1, 2)).numpy()
    for number in range(2):
        for row in range(2):
            for column in range(4):
                cell = np.floor((points[:, :2] - (0, -2)) / (1, 2))
                own = (sample == number) & (cell == (column, row)).all(1)
                wanted = (np.log(1 + own.sum()) / 2, *(values[own].mean(0) if own.any() else (0, 0)))
                np.testing.assert_allclose(found[number, :, row, column], wanted, atol=1e-5)


class Columns(nn.Module):
    """A painter whose cell in column c is surely of class c modulo four."""

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """Return logits (B, 4, H / 4, W / 4)."""
        rows, columns = (side // STRIDE for side in pictures.shape[2:])
        classes = torch.arange(columns) % len(PAINT_CLASSES)
        logits = 50.0 * torch.nn.functional.one_hot(classes, len(PAINT_CLASSES)).float()
        return logits.T[None, :, None].expand(1, -1, rows, -1)


def test_a_pixel_has_the_scores_of_its_cell() -> None:
    pixels = np.array([(0.0, 0.0), (3.4, 10.0), (3.6, 10.0), (9.0, 33.0), (69.0, 0.0)])
    scores = paint(Columns(), np.zeros((34, 70, 3), np.uint8), pixels)  # pyright: ignore[reportArgumentType]
    assert scores.argmax(1).tolist() == [0, 0, 1, 2, 1]
    np.testing.assert_allclose(scores.sum(1), 1, rtol=1e-5)


def with_camera(level: int, points: np.ndarray) -> Frame:
    """Return a frame with a camera at the LiDAR, 64 x 32 pixels with a focal length of 32, of one brightness."""
    plain = frame([], points=points.astype(np.float32))
    intrinsics, distortion = {"camera": np.array([[32.0, 0, 31.5], [0, 32, 15.5], [0, 0, 1]])}, {"camera": np.zeros(5)}
    mounts = {**plain.assumed.agent_from_sensor, "camera": pose(0, 0, 1.8) @ OPTICAL}
    calibration = Calibration(mounts, intrinsics, distortion)
    picture = CameraImage(np.full((32, 64, 3), level, np.uint8))
    return replace(plain, calibration=calibration, assumed=calibration, images={"camera": picture})


def test_points_are_painted_by_the_pixel_that_shows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modalities, "load_painter", Columns)
    points = np.array([(10, 0, 0, 0.1), (10, 2.5, 0, 0.2), (-10, 0, 0, 0.3), (10, 0, 9, 0.4)])
    cloud = read_cloud(with_camera(99, points), PAINTED)
    # At the left one: u = 31.5 - 32 * 2.5 / 10 = 23.5, column 24 // 4 = 6; straight ahead u = 31.5, column 8
    assert cloud[:2, 4:].argmax(1).tolist() == [0, 2]
    assert (cloud[2:, 4:] == 0).all()
    np.testing.assert_array_equal(cloud[:, :4], points.astype(np.float32))
    assert (read_cloud(with_camera(3, points), PAINTED)[:, 4:] == 0).all()  # a black picture
    assert (read_cloud(replace(with_camera(99, points), images={}), PAINTED)[:, 4:] == 0).all()


def test_classes_of_pixels_are_those_of_their_tags() -> None:
    tags = np.array([SEMANTICS[name] for name in ("road", "bus", "pedestrian", "rider", "bicycle", "sky")], np.uint8)
    assert [PAINT_CLASSES[k] for k in classes_of(tags)] == [
        *("else", "vehicle", "person", "two-wheeler", "two-wheeler", "else")
    ]
    assert new_painter()(torch.zeros(1, 3, 32, 64)).shape == (1, len(PAINT_CLASSES), 8, 16)


def cloud_of(kind: str) -> np.ndarray:
    rng = np.random.default_rng(2)
    sweep = rng.uniform((0, -20, -2, 0), (60, 20, 0, 1), (3000, 4)).astype(np.float32)
    if kind == "painted":
        return np.column_stack((sweep, rng.dirichlet((1, 1, 1, 1), 3000))).astype(np.float32)
    echoes = rng.uniform((0, -20, -1.3, -1, -9, -20), (60, 20, -1.3, -1, 9, 30), (300, 6)).astype(np.float32)
    return np.concatenate((widen(sweep, 6), echoes))


@pytest.mark.parametrize("kind", ["radar", "painted"])
def test_a_sensor_that_fails_looks_like_a_sweep_alone(kind: str) -> None:
    config = {"radar": RADAR, "painted": PAINTED}[kind]
    torch.manual_seed(0)
    network, cloud = second(config), cloud_of(kind)
    seen, failed, alone = (voxels_of(network, [each]) for each in (cloud, blind(cloud), cloud_of(kind)[:3000, :4]))
    assert isinstance(seen, torch.Tensor)
    assert torch.equal(failed, alone)  # pyright: ignore[reportArgumentType]
    assert not torch.equal(seen, alone)  # pyright: ignore[reportArgumentType]
    statistics = seen.shape[1] - 1 - (cloud.shape[1] - 4)
    assert torch.equal(seen[:, :statistics], alone[:, :statistics])  # pyright: ignore[reportIndexIssue]
    (found,) = detect_all(network, [cloud], score_threshold=0.0)
    assert found.speed is not None
    if kind == "radar":  # echoes in a box tell its speed
        assert find_echoes(found, cloud).any()
        np.testing.assert_array_equal(np.asarray(take_speeds(found, cloud).speed), found.speed)
    drawn = augment(
        Sample(cloud, Boxes.empty()), Augmentation(turn_rad=0, scale=0, blind=0.99), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(drawn.points, blind(cloud))
    with pytest.raises(ValueError, match="needs pillars"):
        replace(config, pillar_channels=())


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["radar", "painted"])
def test_messages_hold_both_modalities(kind: str, compressed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    config = {"radar": RADAR, "painted": PAINTED}[kind]
    cloud = cloud_of(kind)
    monkeypatch.setattr("flcav.perception.objects.samples.read_cloud", lambda *_: cloud)
    seen = with_radar(np.zeros((0, 5))) if kind == "radar" else frame([("a", "car", 20, 0, 9)])
    message = pack_sample(seen, config)
    more = 300 * 20 if kind == "radar" else 3000 * 4
    assert 0 < len(message) - (3000 * 16 + more) < 2500
    made = unpack_sample(compress_sample(message) if compressed else message, config)
    np.testing.assert_allclose(made.points, cloud, atol=0.0051)
    assert made.boxes.speed is not None
    assert (made.points[:, 3] == ECHO).sum() == (300 if kind == "radar" else 0)
    bare = unpack_sample(pack_sample(frame([]), CONFIGURATIONS["pillars_far"]), config)
    assert bare.points.shape[1] == config.columns


def boxes(speed: list[float], yaw: list[float], x: list[float], score: float = 0.9) -> Boxes:
    rows = [(at, 0.0, -1.0, 4.4, 1.8, 1.6, angle) for at, angle in zip(x, yaw, strict=True)]
    return replace(Boxes.from_array(rows, "Car", [score] * len(rows)), speed=np.array(speed))


def test_boxes_keep_their_speeds() -> None:
    pair = boxes([3.0, np.nan], [0.0, 1.0], [10, 20])
    np.testing.assert_array_equal(pair[[1, 0]].speed, [np.nan, 3.0])
    np.testing.assert_array_equal(pair.transform(pose(1, 2, 3, 0.4)).speed, pair.speed)
    np.testing.assert_array_equal(concatenate([pair, pair[:1]]).speed, [3.0, np.nan, 3.0])
    assert concatenate([pair, replace(pair, speed=None)]).speed is None


def test_the_error_of_a_velocity_is_that_of_a_vector() -> None:
    """By hand: 5 for 4 m/s; right speed, wrong way, 2 * 6; a score below the threshold; an unknown speed."""
    targets = boxes([4.0, 6.0, 2.0, np.nan, 0.0], [0.0, 0, 0, 0, 0], [10, 20, 30, 40, 50])
    found = boxes([5.0, 6.0, 9.0, 1.0, 0.25], [0.0, np.pi, 0, 0, 0], [10, 20, 30, 40, 50])
    found = replace(found, score=np.array([0.9, 0.9, 0.1, 0.9, 0.9]))
    errors, speeds = list_velocity_errors(found, targets)
    np.testing.assert_allclose(errors, [1.0, 12.0, 0.25], atol=1e-9)
    np.testing.assert_allclose(speeds, [4.0, 6.0, 0.0])
    truth = FrameTruth("s", targets, Boxes.empty(), Boxes.empty())
    (row,) = measure_velocities([found], [truth], ["Car"])
    assert (row.median_m_s, row.moving, row.standing_m_s, row.standing) == (6.5, 2, 0.25, 1)
    assert measure_velocities([replace(found, speed=None)], [truth], ["Car"]) == ()


def test_the_speed_is_learned_where_it_is_known() -> None:
    config = CONFIGURATIONS["pillars_far"]
    sample = Sample(np.zeros((0, 4), np.float32), replace(boxes([7.0, np.nan], [0.0, 0], [12, 30]), score=None))
    target = assign_anchors(sample, config)
    assert target.speed is not None
    known = ~target.speed.isnan()
    assert 0 < known.sum() < len(known)
    output = torch.full((1, len(target.weight), 1), 0.5)
    lost = speed_loss(output, target.positive, [target])
    beta = 1 / 9
    np.testing.assert_allclose(lost[known], abs(0.5 - 7 / SPEED_M_S) - beta / 2, rtol=1e-5)
    assert (lost[~known] == 0).all()
    empty = [torch.zeros(1, len(target.weight), width) for width in (1, 7, 2)]
    more, less = (
        second_loss(HeadOutput(*empty, speed=each), [target], config) for each in (output, torch.full_like(output, 0.7))
    )
    assert float(more - less) == pytest.approx(SPEED_WEIGHT * float(lost.sum()) / len(lost), abs=1e-4)


def test_late_fusion_takes_speeds_from_echoes_and_scores_by_them() -> None:
    found = boxes([0.0, 0.0, 0.0], [0.0, np.pi, np.pi / 2], [10, 20, 30], 0.5)
    rows = [(10, 0, -1.3, ECHO, 6, 0), (20, 0.3, -1.3, ECHO, 5, 0), (30, 0, -1.3, ECHO, 5, 0), (10, 0, -1, 0.5, 0, 0)]
    cloud = np.array(rows, np.float32)
    fused = fuse_late(found, cloud, LateFusion((1.0, 2.0), (1.0, -1.0)))
    assert fused.speed is not None
    np.testing.assert_allclose(fused.speed, [6, -5, 0], atol=1e-3)  # the third is across the line of sight
    np.testing.assert_allclose(np.asarray(fused.score), 1 / (1 + np.exp(-2.0)))
    unseen = fuse_late(found, cloud[3:], LateFusion((1.0, 2.0), (1.0, -1.0)))
    np.testing.assert_allclose(np.asarray(unseen.score), 1 / (1 + np.exp(1.0)))
    truth = FrameTruth("s", found[:1], Boxes.empty(), Boxes.empty())
    fitted = fit_late_fusion([found] * 20, [cloud[[0, 3]]] * 20, [truth] * 20, "Car")
    assert fitted.seen == (1.0, 0.0)  # all with an echo are right
    assert fitted.unseen == (1.0, 0.0)  # and none of the others


class FewFrames:
    """As much of a dataset as the check reads: two vehicles, the second without the sensor."""

    folder = "data"

    def __init__(self, offset_ms: float, sensors: int) -> None:
        self.keys = [type("Key", (), {"agent": f"cav{i}"}) for i in range(2)]
        calibration = type("Both", (), {"assumed": Calibration({}, offset_ms={"radar": offset_ms, "top": 10.0})})
        self.calibrations = {"cav0": calibration, "cav1": calibration}
        self._sensors = sensors

    def __len__(self) -> int:
        return 2

    def radars(self, number: int) -> list[str]:
        return ["radar"] if number < self._sensors else []

    cameras = radars

    def lidars(self, number: int) -> list[str]:
        return ["top"]

    def frame(self, number: int) -> int:
        return number


@pytest.mark.parametrize(
    ("offset_ms", "sensors", "told"),
    [
        (0.0, 0, "data: no radar in its frames, which the network reads beside the LiDAR"),
        (150.0, 1, "data: clocks disagree: cav0's 'radar' is 140 ms after its LiDAR, and a spin takes 100 ms"),
        (-95.0, 1, "cav0's 'radar' is -105 ms after its LiDAR"),
        (np.nan, 1, "clocks disagree"),
    ],
)
def test_a_folder_without_the_modality_and_other_clocks_are_one_sentence(offset_ms: float, sensors: int, told: str):
    with pytest.raises(InputError, match=re.escape(told)):
        modalities.frames_beside(FewFrames(offset_ms, sensors), RADAR, [0, 1])  # pyright: ignore[reportArgumentType]


def test_a_vehicle_without_the_sensor_is_read_beside_the_others() -> None:
    few = FewFrames(109.0, 1)
    assert modalities.frames_beside(few, RADAR, [1])(1) == 1  # pyright: ignore[reportArgumentType]
    assert modalities.frames_beside(few, RADAR, [0])(0) == 0  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="no camera in its frames"):
        modalities.frames_beside(FewFrames(0, 0), PAINTED, [0])  # pyright: ignore[reportArgumentType]
