"""What each 3D format says of every frame, read as its users read it and put into our LiDAR frame.

KITTI and MCAP by the readers there are (MCAP's own library); nuScenes and OPV2V by following what nuscenes-devkit and
OpenCOOD do with the files, and refusing what they would not expect.
"""

import csv
import json
from collections import defaultdict
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from flcav.dataset.formats.kitti import KittiFolder
from flcav.geometry import Boxes


@dataclass(frozen=True)
class Seen:
    """One frame, in the LiDAR frame: x ahead, y left, z up."""

    boxes: Boxes
    points: NDArray  # (N, 4) x, y, z, intensity
    images: list[tuple[NDArray, NDArray]]  # (H, W, 3) and the (3, 4) projection from the LiDAR frame


def kitti(out: Path) -> dict[str, Seen]:
    folder = KittiFolder.open(out)
    with (out / "frames.csv").open(encoding="utf-8") as file:
        key = {row["number"]: row["frame"] for row in csv.DictReader(file)}
    seen = {}
    for i, name in enumerate(folder.names):
        frame = folder.frame(i)
        projection = frame.calibration.image_from_camera @ frame.calibration.camera_from_lidar
        seen[key[name]] = Seen(frame.objects.boxes, frame.points, [(frame.image, projection)])
    return seen


def nuscenes(out: Path) -> dict[str, Seen]:
    names = ["attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"]
    names += ["sample_annotation", "sample_data", "scene", "sensor", "visibility"]
    listed = {name: json.loads((out / "v1.0-flcav" / f"{name}.json").read_text()) for name in names}
    table = {name: {row["token"]: row for row in rows} for name, rows in listed.items()}
    assert all(len(table[name]) == len(listed[name]) for name in names), "a token is used twice"
    assert (out / listed["map"][0]["filename"]).is_file()
    seen = {}
    for scene in listed["scene"]:
        log = table["log"][scene["log_token"]]
        token, samples = scene["first_sample_token"], []
        while token:
            samples.append(table["sample"][token])
            token = samples[-1]["next"]
        assert len(samples) == scene["nbr_samples"]
        assert samples[-1]["token"] == scene["last_sample_token"]
        for index, sample in enumerate(samples):
            seen[f"{log['logfile']}_{index:04d}_{log['vehicle']}"] = _sample(out, table, sample)
    return seen


def _sample(out: Path, table: dict, sample: dict) -> Seen:
    data = {}
    for row in table["sample_data"].values():
        if row["sample_token"] == sample["token"]:
            calibrated = table["calibrated_sensor"][row["calibrated_sensor_token"]]
            sensor = table["sensor"][calibrated["sensor_token"]]
            world_from_sensor = _placed(table["ego_pose"][row["ego_pose_token"]]) @ _placed(calibrated)
            data[sensor["channel"]] = (row, calibrated, world_from_sensor)
    theirs_from_ours = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    row, _, world_from_lidar = data["LIDAR_TOP"]
    world_from_ours = world_from_lidar @ theirs_from_ours
    raw = np.fromfile(out / row["filename"], np.float32).reshape(-1, 5)
    points = np.column_stack((raw[:, 1], -raw[:, 0], raw[:, 2], raw[:, 3] / 255))
    boxes, labels = [], []
    for note in table["sample_annotation"].values():
        if note["sample_token"] == sample["token"]:
            instance = table["instance"][note["instance_token"]]
            assert note["visibility_token"] in table["visibility"]
            assert all(token in table["attribute"] for token in note["attribute_tokens"])
            labels.append(table["category"][instance["category_token"]]["name"])
            width, length, height = note["size"]
            boxes.append(_box(np.linalg.inv(world_from_ours) @ _placed(note), (length, width, height)))
    images = []
    for channel, (row, calibrated, world_from_camera) in data.items():
        if channel.startswith("CAM"):
            pixels = np.asarray(Image.open(out / row["filename"]))
            assert pixels.shape[:2] == (row["height"], row["width"])
            camera_from_ours = np.linalg.inv(world_from_camera) @ world_from_ours
            images.append((pixels, np.array(calibrated["camera_intrinsic"]) @ camera_from_ours[:3]))
    return Seen(Boxes.from_array(boxes, labels), points, images)


def nuscenes_points(out: Path) -> list[tuple[list, list]]:
    """Return of each sample the (M, 2) points of LiDAR and radar that its annotations claim, and that lie in them."""
    tables = {path.stem: json.loads(path.read_text()) for path in (out / "v1.0-flcav").glob("*.json")}
    by = {name: {row["token"]: row for row in rows} for name, rows in tables.items() if isinstance(rows, list)}
    found = []
    for sample in tables["sample"]:
        clouds = {"lidar": [np.zeros((0, 3))], "radar": [np.zeros((0, 3))]}
        for row in tables["sample_data"]:
            calibrated = by["calibrated_sensor"][row["calibrated_sensor_token"]]
            kind = by["sensor"][calibrated["sensor_token"]]["modality"]
            if row["sample_token"] == sample["token"] and kind in clouds:
                data = (out / row["filename"]).read_bytes()
                if kind == "lidar":
                    points = np.frombuffer(data, "<f4").reshape(-1, 5)[:, :3]
                else:  # 43 bytes an echo, as the devkit has them, and one byte more
                    rest = data.partition(b"DATA binary\n")[2][:-1]
                    points = np.frombuffer(rest, "u1").reshape(-1, 43)[:, :12].copy().view("<f4")
                world_from_sensor = _placed(by["ego_pose"][row["ego_pose_token"]]) @ _placed(calibrated)
                clouds[kind].append(points @ world_from_sensor[:3, :3].T + world_from_sensor[:3, 3])
        said, inside = [], []
        for note in tables["sample_annotation"]:
            if note["sample_token"] == sample["token"]:
                said.append([note["num_lidar_pts"], note["num_radar_pts"]])
                box_from_world, half = np.linalg.inv(_placed(note)), np.array(note["size"])[[1, 0, 2]] / 2
                own = [
                    np.concatenate(cloud) @ box_from_world[:3, :3].T + box_from_world[:3, 3]
                    for cloud in clouds.values()
                ]
                inside.append([int((np.abs(points) <= half).all(axis=1).sum()) for points in own])
        found.append((said, inside))
    return found


def opv2v(out: Path) -> dict[str, Seen]:
    seen = {}
    for scenario in sorted(path for split in out.iterdir() for path in split.iterdir()):
        protocol = yaml.safe_load((scenario / "data_protocol.yaml").read_text())
        agent = {number: name for name, number in protocol["numbers"].items()}
        folders = sorted(path for path in scenario.iterdir() if path.is_dir())
        assert int(folders[0].name) >= 0, "the first agent would not be the ego"
        stamps = [path.stem for path in sorted(folders[0].glob("*.yaml"))]
        for folder in folders:
            assert [path.stem for path in sorted(folder.glob("*.yaml"))] == stamps
            for stamp in stamps:
                seen[f"{scenario.name}_{int(stamp):04d}_{agent[int(folder.name)]}"] = _opv2v_frame(folder, stamp)
    return seen


def _opv2v_frame(folder: Path, stamp: str) -> Seen:
    mirror = np.diag([1.0, -1, 1, 1])
    about = yaml.safe_load((folder / f"{stamp}.yaml").read_text())
    lidar_from_world = np.linalg.inv(_x_to_world(about["lidar_pose"]))
    boxes = []
    for vehicle in about["vehicles"].values():
        middle = np.add(vehicle["location"], vehicle["center"]).tolist()
        lidar_from_box = mirror @ lidar_from_world @ _x_to_world([*middle, *vehicle["angle"]]) @ mirror
        boxes.append(_box(lidar_from_box, 2 * np.array(vehicle["extent"])))
    header, _, data = (folder / f"{stamp}.pcd").read_bytes().partition(b"DATA binary\n")
    fields = dict(line.split(maxsplit=1) for line in header.decode().splitlines()[1:])
    assert (fields["FIELDS"], fields["SIZE"], fields["TYPE"]) == ("x y z rgb", "4 4 4 4", "F F F F")
    raw = np.frombuffer(data, "<f4").reshape(int(fields["POINTS"]), 4)
    red = raw[:, 3].copy().view("<u4") >> 16 & 255
    points = np.column_stack((raw[:, 0], -raw[:, 1], raw[:, 2], red / 255))
    images = []
    for i in range(4):
        if f"camera{i}" in about:
            camera = about[f"camera{i}"]
            camera_from_lidar = np.array(camera["extrinsic"])
            world_from_camera = _x_to_world(camera["cords"])
            np.testing.assert_allclose(world_from_camera @ camera_from_lidar @ lidar_from_world, np.eye(4), atol=1e-9)
            optical_from_body = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # y to the right
            projection = np.array(camera["intrinsic"]) @ (optical_from_body @ camera_from_lidar @ mirror)[:3]
            images.append((np.asarray(Image.open(folder / f"{stamp}_camera{i}.png")), projection))
    return Seen(Boxes.from_array(boxes, "vehicle"), points, images)


def _x_to_world(pose: list[float]) -> NDArray:
    """Return CARLA's left-handed transform of x, y, z, roll, yaw, pitch [degrees]."""
    x, y, z, roll, yaw, pitch = pose
    out = np.eye(4)
    about_x, about_y = Rotation.from_euler("x", -roll, degrees=True), Rotation.from_euler("y", -pitch, degrees=True)
    out[:3, :3] = (Rotation.from_euler("z", yaw, degrees=True) * about_y * about_x).as_matrix()
    out[:3, 3] = x, y, z
    return out


def mcap(out: Path) -> dict[str, Seen]:
    seen = {}
    for path in sorted(out.glob("*.mcap")):
        messages = defaultdict(list)
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[_Decoder()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                agent, topic = channel.topic[1:].split("/", 1)
                messages[agent].append((message.log_time, topic, decoded))
        for agent, logged in messages.items():
            spins = sorted(time for time, topic, _ in logged if topic == "objects")
            for index, spin in enumerate(spins):
                near = [(time, topic, decoded) for time, topic, decoded in logged if abs(time - spin) <= 100e6]
                seen[f"{path.stem}_{index:04d}_{agent}"] = _mcap_frame(spin, near)
    return seen


def mcap_topics(path: Path) -> dict[str, list]:
    """Return topic -> messages of one file."""
    topics = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, _, decoded in make_reader(file, decoder_factories=[_Decoder()]).iter_decoded_messages():
            topics[channel.topic].append(decoded)
    return topics


class _Decoder(DecoderFactory):
    """MCAP's decoder for protobuf, which knows JSON too."""

    def decoder_for(self, message_encoding: str, schema: Schema | None):
        return json.loads if message_encoding == "json" else super().decoder_for(message_encoding, schema)


def _mcap_frame(spin: int, messages: list) -> Seen:
    topics = {topic: decoded for _, topic, decoded in messages if topic != "tf"}
    parent = {
        (item.timestamp.ToNanoseconds(), item.child_frame_id): (item.parent_frame_id, item)
        for _, topic, decoded in messages
        if topic == "tf"
        for item in decoded.transforms
    }

    def world_from(frame_id: str, time: int) -> NDArray:
        out = np.eye(4)
        while frame_id != "world":  # mounts are known from the spin on, the agent moves
            frame_id, item = parent.get((time, frame_id)) or parent[spin, frame_id]
            out = _matrix(item.translation, item.rotation) @ out
        return out

    cloud = topics["lidar/points"]
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity"]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    lidar_from_world = np.linalg.inv(world_from(cloud.frame_id, cloud.timestamp.ToNanoseconds()))
    boxes, labels = [], []
    for entity in topics["objects"].entities:
        assert entity.frame_id == "world"
        cube = entity.cubes[0]
        size = (cube.size.x, cube.size.y, cube.size.z)
        boxes.append(_box(lidar_from_world @ _matrix(cube.pose.position, cube.pose.orientation), size))
        labels.append(next(item.value for item in entity.metadata if item.key == "class"))
    images = []
    for topic, message in topics.items():
        if topic.endswith("/image") and message.DESCRIPTOR.name == "CompressedImage":
            assert message.format == "png"
            calibration = topics[topic.replace("/image", "/calibration")]
            pixels = np.asarray(Image.open(BytesIO(message.data)))
            assert pixels.shape[:2] == (calibration.height, calibration.width)
            world_from_camera = world_from(message.frame_id, message.timestamp.ToNanoseconds())
            camera_from_lidar = np.linalg.inv(world_from_camera) @ np.linalg.inv(lidar_from_world)
            images.append((pixels, np.array(calibration.P).reshape(3, 4) @ camera_from_lidar))
    return Seen(Boxes.from_array(boxes, labels), points, images)


def _matrix(translation, rotation) -> NDArray:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat((rotation.x, rotation.y, rotation.z, rotation.w)).as_matrix()
    out[:3, 3] = translation.x, translation.y, translation.z
    return out


def _placed(row: dict) -> NDArray:
    w, x, y, z = row["rotation"]
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
    out[:3, 3] = row["translation"]
    return out


def _box(lidar_from_box: NDArray, size) -> list[float]:
    assert lidar_from_box[2, 2] > 0.999, "the box is not upright"
    return [*lidar_from_box[:3, 3], *size, float(np.arctan2(lidar_from_box[1, 0], lidar_from_box[0, 0]))]


READERS = {"kitti": kitti, "nuscenes": nuscenes, "opv2v": opv2v, "mcap": mcap}
