"""Navigation logs of a scene as a Parquet file, with one row per vehicle and its samples as lists, and their check."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import Config, InputError, parse_config
from flcav.dataset.frame_checks import FORCE, RATE
from flcav.sensors.navigation import Gnss, Imu
from flcav.sensors.navigation_log import NavigationLog
from flcav.storage.files import atomic_path, read_parquet

Sheet = TypeVar("Sheet", bound=Config)

SAMPLES = {"fix_time_s": 1, "fix": 3, "imu_time_s": 1, "inertia": 6}  # numbers of each sample
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("agent", "gnss", "imu")),  # vehicle, and names of its sensors
        *((name, pa.string()) for name in ("receiver", "unit")),  # data sheets of the sensors: fields in JSON
        *((name, pa.list_(pa.float64())) for name in SAMPLES),  # row-major, see `NavigationLog`
    ]
)


def save_logs(logs: Mapping[str, NavigationLog], path: Path) -> None:
    """Write the logs of a scene's vehicles, given by vehicle name, to the file `path`."""
    rows: list[dict[str, Any]] = [
        {
            "agent": agent,
            **{"gnss": log.gnss, "imu": log.imu},
            **{"receiver": log.receiver.model_dump_json(), "unit": log.unit.model_dump_json()},
            **{name: getattr(log, name).ravel() for name in SAMPLES},
        }
        for agent, log in logs.items()
    ]
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), temporary, compression="zstd")


def load_logs(path: Path) -> dict[str, NavigationLog]:
    """Return the logs that `save_logs` wrote, by vehicle; raises `InputError` where the file or a log is damaged."""
    table = read_parquet(path)
    if not table.schema.equals(SCHEMA) or any(column.null_count for column in table.columns):
        raise InputError(f"{path}: not the navigation logs of a scene ({', '.join(SCHEMA.names)}, without empty cells)")
    logs = {}
    for number, agent in enumerate(table["agent"].to_pylist()):
        where = f"{path}: the log of '{agent}'"
        named = {name: str(table[name][number].as_py()) for name in ("gnss", "imu", "receiver", "unit")}
        values = {name: np.asarray(table[name][number].values.to_numpy(zero_copy_only=False)) for name in SAMPLES}
        if any(len(values[name]) % width for name, width in SAMPLES.items()):
            raise InputError(f"{where} has an incomplete sample")
        samples = {name: values[name].reshape(-1, width) for name, width in SAMPLES.items()}
        logs[agent] = log = NavigationLog(
            gnss=named["gnss"],
            imu=named["imu"],
            receiver=_parse(Gnss, named["receiver"], where),
            unit=_parse(Imu, named["unit"], where),
            fix_time_s=samples["fix_time_s"][:, 0],
            fix=samples["fix"],
            imu_time_s=samples["imu_time_s"][:, 0],
            inertia=samples["inertia"],
        )
        for problem in check_log(log):
            raise InputError(f"{where} {problem}")
    return logs


def _parse(model: type[Sheet], text: str, where: str) -> Sheet:
    """Return a data sheet, given its fields in JSON."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(f"{where} has a data sheet that is no JSON") from None
    return parse_config(model, fields, where)


GAP = 1.5  # longest time between two IMU samples, in periods of its rate
FIX_GAP_S = 5.0  # longest time between two fixes
HIGHEST_M = 1e5  # greatest altitude [m]


def check_log(log: NavigationLog) -> Iterator[str]:
    """Check that times ascend without gaps, numbers are finite, and positions and motions are possible.

    The sentences begin with their verb: the caller names the log.
    """
    kinds = (
        ("fixes", log.fix_time_s, log.fix, FIX_GAP_S),
        ("IMU samples", log.imu_time_s, log.inertia, GAP / log.unit.rate_hz),
    )
    for kind, times_s, values, longest_s in kinds:
        if len(times_s) != len(values) or len(times_s) < 2:
            yield f"has {len(values)} {kind} at {len(times_s)} times; two or more are wanted"
            return
        if not (np.isfinite(times_s).all() and np.isfinite(values).all()):
            yield f"has {kind} that are not finite"
            return
        steps = np.diff(times_s)
        if steps.min() <= 0:
            yield f"has {kind} whose time runs backwards after {times_s[steps.argmin()]:.2f} s"
        elif steps.max() > longest_s:
            yield f"has no {kind} for {steps.max():.2f} s after {times_s[steps.argmax()]:.2f} s"
    if (np.abs(log.fix).max(axis=0) > (90, 180, HIGHEST_M)).any():
        yield "has fixes that are nowhere on Earth"
    if not (np.abs(log.inertia[:, :3]).max() < FORCE and np.abs(log.inertia[:, 3:]).max() < RATE):
        yield "reports a motion that nothing survives"
