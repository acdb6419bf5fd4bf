"""Navigation logs of a scene as a Parquet file: one row per vehicle, its samples as lists."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import Config, InputError, parse_config
from flcav.dataset.checks.navigation import check_log
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
    """Write the logs of a scene's vehicles, by name."""
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
    """Return vehicle -> log as `save_logs` wrote them; raises `InputError` where the file or a log is damaged."""
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
    """Return a data sheet from its fields in JSON."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(f"{where} has a data sheet that is no JSON") from None
    return parse_config(model, fields, where)
