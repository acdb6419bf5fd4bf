"""Reading of nuScenes' tables and files, as nuscenes-devkit reads them: the key frames, which are those with boxes.

The ego vehicle's frame is on the ground below the rear axle; the world is nuScenes' global frame. Splits of nuScenes
are in its devkit's code rather than in its files; an export of flcav has them, and its logs name scene and agent.
"""

from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flcav.config import InputError, path_within, read_json, shorten
from flcav.dataset.formats.clouds import read_pcd
from flcav.dataset.formats.nuscenes.files import OURS_FROM_LIDAR, VERSION, decode_radar, read_nuscenes_points
from flcav.dataset.formats.nuscenes.tables import COLUMNS, References, Row, read_rows_by_token, stream_table
from flcav.dataset.formats.reading import (
    AgentNames,
    ImportFormat,
    LogPicture,
    LogSource,
    annotate,
    assign_split,
    check_sizes,
    choose_split,
    difference_tracks,
    group_classes,
    link_pictures,
    pinhole,
    view_boxes,
)
from flcav.geometry import Array, inverse, turned_boxes
from flcav.sensors.frame import Calibration, LinkedFrame

SMALL = [name for name in COLUMNS if name not in ("sample_data", "ego_pose", "sample_annotation")]  # kept as they are

# Other classes keep their names, and so do cycles without a rider.
CATEGORIES = group_classes(
    car="vehicle.car vehicle.emergency.police",
    truck="vehicle.truck vehicle.trailer vehicle.construction vehicle.emergency.ambulance",
    bus="vehicle.bus.rigid vehicle.bus.bendy",
    pedestrian="human.pedestrian.adult human.pedestrian.child human.pedestrian.construction_worker "
    "human.pedestrian.police_officer",
)
RIDDEN = {"vehicle.bicycle": "bicycle", "vehicle.motorcycle": "motorcycle"}
RIDER = "cycle.with_rider"
OCCLUSION = {"1": 0.8, "2": 0.5, "3": 0.3, "4": 0.1}  # middles of the levels: 0-40 %, 40-60, 60-80, 80-100 visible
TOP, MOUNTED = "LIDAR_TOP", "calibrated_sensor.json"
BEAMS, RANGE_M = 32, 70.0  # of nuScenes' LiDAR (Caesar et al., CVPR 2020, table 2); other folders do not state them
VERSIONS = ("v1.0-mini", "v1.0-trainval", "v1.0-test")  # tables distributed by nuScenes


class Spin(NamedTuple):
    """A key frame: its sample, and where it belongs in a dataset."""

    sample: str  # token
    agent: str
    number: int
    time_s: float


class NuscenesSource(LogSource):
    """The key frames of a nuScenes folder, or of a folder with its tables, such as `v1.0-mini`."""

    FORMAT = "nuscenes"

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Open the tables; raises `InputError` where they are missing or malformed, or there is nothing of `split`."""
        self.folder, self.split = folder, split
        self._tables = _find_tables(folder)
        self._root = self._tables.parent
        table = {name: read_rows_by_token(self._tables, name) for name in SMALL}
        self._references = References()
        for _ in self._references.check_links(table["sample"].values(), "sample", self._tables / "sample.json"):
            pass
        self._data: dict[str, dict[str, Row]] = defaultdict(dict)  # sample -> channel -> row of sample_data
        self._mounted, self._channel = table["calibrated_sensor"], table["sensor"]
        self._lost: dict[str, set[str]] = defaultdict(set)  # sample -> channels whose file is not there
        listed = self._tables / "sample_data.json"
        first_lost = None
        for row in self._stream("sample_data"):
            if not row["is_key_frame"]:
                continue
            if row["sample_token"] not in table["sample"]:
                self._references.miss("sample_data", "sample_token", row["sample_token"])
                continue
            path_within(self._root, row["filename"], listed)
            mounted = self._at(self._mounted, row, "calibrated_sensor_token")
            channel, of_sample = (
                self._at(self._channel, mounted, "sensor_token")["channel"],
                self._data[row["sample_token"]],
            )
            if not (file := self._root / row["filename"]).is_file():  # a device, too, would be read without end
                first_lost = first_lost or file
                self._lost[row["sample_token"]].add(channel)
                continue
            if (one := of_sample.setdefault(channel, row)) is not row:
                raise InputError(
                    f"{listed}: {shorten(row['filename'])} is a second one of {channel} at {row['timestamp']} of a "
                    f"sample, beside {shorten(one['filename'])}"
                )
        used = {row["ego_pose_token"] for rows in self._data.values() for row in rows.values()}
        self._pose = read_rows_by_token(self._tables, "ego_pose", lambda row: row["token"] in used)
        self._calibration: dict[str, Calibration] = {}  # by agent
        self._spins, split_of = self._order(table["scene"], table["log"], table["sample"])
        if first_lost is not None and not self._spins:
            raise InputError(f"{first_lost}: no such file, nor is that of any other sweep of {TOP}")
        self.split_of = {scene: split_of[scene] for scene in choose_split(folder, split_of, split)}
        self._read_notes(table)
        if self._tables.name in VERSIONS:
            self.beams, self.range_m = BEAMS, RANGE_M
        self.labelled = bool(self._notes)
        self.notes = () if self.labelled else ("no annotations in its tables, so no boxes",)
        self.notes += tuple(self._references.notes())
        if lost := sum(map(len, self._lost.values())):
            whole = sum(TOP not in channels for channels in self._lost.values())
            self.notes += (
                f"files of its tables that are not there: {lost}, the first is {first_lost}; left out with them: "
                f"{len(self._lost) - whole} of {len(table['sample'])} key frames, which lack {TOP}",
            )

    def _at(self, table: Mapping[str, Row], row: Row, column: str) -> Row:
        """Return the row to which a column of another row refers; raises `InputError` where there is none."""
        if row[column] not in table:
            raise self._unknown(row, column)
        return table[row[column]]

    def _stream(self, name: str) -> Iterator[Row]:
        """Yield the rows of a table, and check their references."""
        return self._references.check_links(stream_table(self._tables, name), name, self._tables / f"{name}.json")

    def _unknown(self, row: Row, column: str) -> InputError:
        return InputError(
            f"{self._tables}: its tables do not fit together, nothing has the token '{row[column]}', which is the "
            f"{column} of '{row['token']}'"
        )

    def _kind(self, row: Row) -> str:
        """Return the modality of a row of sample_data: "lidar", "camera" or "radar"."""
        mounted = self._at(self._mounted, row, "calibrated_sensor_token")
        return self._at(self._channel, mounted, "sensor_token")["modality"]

    def _pixels(self, row: Row) -> tuple[int, int]:
        """Return width and height [px] of a picture, from its row of sample_data."""
        if not row.get("width") or not row.get("height"):
            raise InputError(f"{self._tables / 'sample_data.json'}: no width and height of '{row['filename']}'")
        return row["width"], row["height"]

    def _fingerprint(self, data: Mapping[str, Row]) -> tuple[str, ...]:
        mounted = {channel: self._at(self._mounted, row, "calibrated_sensor_token") for channel, row in data.items()}
        names = ("translation", "rotation", "camera_intrinsic")
        return tuple(f"{channel} {[mounted[channel][name] for name in names]}" for channel in sorted(mounted))

    def _calibrate(self, data: Mapping[str, Row], spin: int) -> Calibration:
        """Return the calibration of an agent from its first row per channel; trigger times relative to `spin` [µs]."""
        mounted = {channel: self._at(self._mounted, row, "calibrated_sensor_token") for channel, row in data.items()}
        ours = {channel: inverse(OURS_FROM_LIDAR) for channel, row in data.items() if self._kind(row) == "lidar"}
        cameras = [channel for channel, row in data.items() if self._kind(row) == "camera"]
        return Calibration(
            {channel: _placed(row) @ ours.get(channel, np.eye(4)) for channel, row in mounted.items()},
            intrinsics={name: np.array(mounted[name]["camera_intrinsic"], np.float64) for name in cameras},
            distortion={name: np.zeros(5) for name in cameras},
            offset_ms={channel: (row["timestamp"] - spin) / 1e3 for channel, row in data.items()},
        )

    def _order(
        self, scenes: Mapping[str, Row], logs: Mapping[str, Row], samples: Mapping[str, Row]
    ) -> tuple[dict[str, list[Spin]], dict[str, str | None]]:
        """Return the spins by scene, ordered by time and agent, and the splits by scene."""
        ours = self._tables.name == VERSION
        names = AgentNames()
        splits = self._tables / "splits.json"
        listed = read_json(splits) if splits.is_file() else {}
        split_by_name: dict[str, str | None] = {}
        for split, names_of in listed.items() if isinstance(listed, dict) else ():
            for name in names_of if isinstance(names_of, list) else ():
                assign_split(split_by_name, str(name), split.removeprefix("flcav_"), splits)
        of_scene: dict[str, list[str]] = defaultdict(list)
        for token, row in samples.items():
            of_scene[row["scene_token"]].append(token)
            if row["scene_token"] not in scenes:
                self._references.miss("sample", "scene_token", row["scene_token"])
        times: dict[str, list[tuple[float, str, str]]] = defaultdict(list)
        split_of: dict[str, str | None] = {}
        for token, scene in scenes.items():
            log, name = self._at(logs, scene, "log_token"), scene["name"]
            if of_scene[token] and scene["first_sample_token"] not in samples:
                self._references.miss("scene", "first_sample_token", scene["first_sample_token"])
            of_scene[token] = [sample for sample in of_scene[token] if TOP not in self._lost.get(sample, ())]
            for sample in of_scene[token]:
                if TOP not in self._data[sample]:
                    raise InputError(f"{self._tables / 'sample_data.json'}: no {TOP} of the sample '{sample}'")
            if not of_scene[token]:
                continue
            own_scene = log["logfile"] if ours else name
            first: dict[str, Row] = {}  # channel -> its first row in the scene
            for sample in of_scene[token]:
                first = {**self._data[sample], **first}
            agent = names.of(log["vehicle"] or "ego", self._fingerprint(first))
            if first and agent not in self._calibration:
                spin = self._data[of_scene[token][0]][TOP]["timestamp"]
                self._calibration[agent] = self._calibrate(first, spin)
            late = name.rpartition("-")[2] if ours else "0"  # [microseconds], see `Drive._micros`
            if not late.isdecimal():
                raise InputError(f"{self._tables / 'scene.json'}: the scene '{name}' is none of an export by flcav")
            times[own_scene] += [((samples[s]["timestamp"] - int(late)) / 1e6, agent, s) for s in of_scene[token]]
            if own_scene in split_of and not ours:
                raise InputError(f"{self._tables / 'scene.json'}: two scenes are called {shorten(name)}")
            split = split_by_name.get(name, "test" if self._tables.name.endswith("-test") else None)
            assign_split(split_of, own_scene, split, splits)
        spins = {}
        for scene, frames in times.items():
            rank = {time: index for index, time in enumerate(sorted({time for time, _, _ in frames}))}
            spins[scene] = [Spin(sample, agent, rank[time], time) for time, agent, sample in sorted(frames)]
            for one, other in pairwise(spins[scene]):
                if (one.time_s, one.agent) == (other.time_s, other.agent):
                    raise InputError(
                        f"{self._tables / 'sample.json'}: the samples '{one.sample}' and '{other.sample}' of the scene "
                        f"'{scene}' have one time stamp, {one.time_s:.6f} s; correct it, or remove one of them"
                    )
        return spins, split_of

    def _read_notes(self, table: Mapping[str, Mapping[str, Row]]) -> None:
        """Store the annotations: boxes in the global frame by sample, with velocities by their instances."""
        category = {
            token: self._at(table["category"], row, "category_token")["name"]
            for token, row in table["instance"].items()
        }
        attribute = {token: row["name"] for token, row in table["attribute"].items()}
        track, time_s, label, occlusion, numbers = [], array("d"), [], array("d"), array("d")
        self._notes: dict[str, list[int]] = defaultdict(list)  # sample -> indices of its annotations
        for number, row in enumerate(self._stream("sample_annotation")):
            self._notes[row["sample_token"]].append(number)
            track.append(row["instance_token"])
            time_s.append(self._at(table["sample"], row, "sample_token")["timestamp"] / 1e6)
            numbers.extend((*row["translation"], *row["size"], *row["rotation"]))
            if (name := category.get(row["instance_token"])) is None:
                raise self._unknown(row, "instance_token")
            ridden = RIDER in (attribute.get(token) for token in row.get("attribute_tokens", ()))
            for unknown in (token for token in row.get("attribute_tokens", ()) if token not in attribute):
                self._references.miss("sample_annotation", "attribute_tokens", unknown)
            if (level := row.get("visibility_token")) and level not in OCCLUSION:
                self._references.miss("sample_annotation", "visibility_token", level)
            label.append(RIDDEN.get(name, name) if ridden else CATEGORIES.get(name, name))
            occlusion.append(OCCLUSION.get(row.get("visibility_token", ""), np.nan))
        center, size, quaternion = np.split(np.reshape(numbers, (-1, 10)), (3, 6), axis=1)
        check_sizes(size, self._tables / "sample_annotation.json")
        turned = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
        self._track, self._occlusion = np.array(track, np.str_), np.array(occlusion)
        self._velocity = difference_tracks(self._track, np.array(time_s), center)
        self._boxes = turned_boxes(center, size[:, [1, 0, 2]], turned, np.array(label, np.str_))

    def frame_count(self, scene: str) -> int:
        """Return the number of key frames of a scene."""
        return len(self._spins[scene])

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield the key frames of a scene; raises `InputError` where a file is missing, truncated or malformed."""
        for spin in self._spins[scene]:
            yield self._frame(scene, spin)

    def _frame(self, scene: str, spin: Spin) -> LinkedFrame:
        data = self._data[spin.sample]
        calibration = self._calibration[spin.agent]
        mounts = calibration.agent_from_sensor
        kind = {name: self._kind(row) for name, row in data.items()}
        poses = {name: _placed(self._at(self._pose, row, "ego_pose_token")) for name, row in data.items()}
        cameras = [name for name in data if kind[name] == "camera"]
        path = {name: self._root / row["filename"] for name, row in data.items()}
        ranging = sorted((name for name in data if kind[name] == "lidar"), key=lambda name: name != TOP)
        clouds = {name: read_nuscenes_points(path[name]) for name in ranging}
        radar = {name: decode_radar(read_pcd(path[name])) for name in data if kind[name] == "radar"}
        rows = self._notes[spin.sample]
        boxes = self._boxes[rows]
        pictures = {
            name: LogPicture(
                path[name],
                pinhole(calibration.intrinsics[name], *self._pixels(data[name]), self._tables / MOUNTED),
                poses[name] @ mounts[name],
            )
            for name in cameras
        }
        files = {name: path[name] for name in cameras}
        return LinkedFrame(
            scene=scene,
            index=spin.number,
            time_s=spin.time_s,
            agent=spin.agent,
            world_from_agent=poses[TOP],
            calibration=calibration,
            assumed=calibration,
            lidar=clouds,
            annotations=annotate(
                self._track[rows].tolist(),
                boxes,
                {name: (cloud, poses[name] @ mounts[name]) for name, cloud in clouds.items()},
                view_boxes(boxes, pictures),
                velocity=self._velocity[rows],
                occlusion=self._occlusion[rows],
            ),
            images=link_pictures(files),
            radar=radar,
            agent_at_trigger={name: then for name, then in poses.items() if not np.array_equal(then, poses[TOP])},
            files=files,
        )


IMPORT = ImportFormat(NuscenesSource, ("v1.0-*/sample.json", "sample.json", "samples/LIDAR_TOP"))


def _find_tables(folder: Path) -> Path:
    if (folder / "sample.json").is_file():
        return folder
    folders = sorted(path.parent for path in folder.glob("v1.0-*/sample.json"))
    if not folders:
        raise InputError(f"{folder}: no nuScenes tables; it holds no folder such as 'v1.0-mini' with a 'sample.json'")
    if len(folders) > 1:
        raise InputError(
            f"{folder}: several folders of tables, {', '.join(path.name for path in folders)}: name one of them"
        )
    return folders[0]


def _placed(row: Row) -> Array:
    """Return the transform (4, 4) [m] of a row's rotation, w x y z, and translation."""
    w, x, y, z = row["rotation"]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat((x, y, z, w)).as_matrix()
    matrix[:3, 3] = row["translation"]
    return matrix
