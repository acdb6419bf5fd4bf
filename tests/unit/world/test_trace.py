"""A trace survives its file to the last bit."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.world.trace import Trace


def make_trace(instants: int = 7, actors: int = 5, lights: int = 3) -> Trace:
    random = np.random.default_rng(3)
    present = random.random((instants, actors)) < 0.6
    absent = np.where(present, 0.0, np.nan)
    return Trace(
        town="grid",
        time_s=np.linspace(60.0, 61.0, instants),
        actor=np.array([f"veh{i}" for i in range(actors)], dtype=np.str_),
        category=np.array(["car"] * actors, dtype=np.str_),
        shape=random.integers(0, 10, actors),
        size=random.random((actors, 3)),
        present=present,
        position=random.normal(size=(instants, actors, 3)) + absent[..., None],
        yaw=random.normal(size=(instants, actors)) + absent,
        velocity=random.normal(size=(instants, actors, 3)) + absent[..., None],
        acceleration=random.normal(size=(instants, actors, 3)) + absent[..., None],
        yaw_rate=random.normal(size=(instants, actors)) + absent,
        light=np.array([f"x:{i}" for i in range(lights)], dtype=np.str_),
        light_state=random.choice(["G", "r", "y"], (instants, lights)).astype("<U1"),
    )


@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 1, 1), (4, 3, 0), (2, 0, 2)])
def test_round_trip_is_exact(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    trace = make_trace(*shape)
    trace.save(tmp_path / "trace.parquet")
    again = Trace.load(tmp_path / "trace.parquet")
    for field in fields(Trace):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(trace, field.name), err_msg=field.name)


def test_same_trace_same_bytes(tmp_path: Path) -> None:
    make_trace().save(tmp_path / "a.parquet")
    make_trace().save(tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_files_that_are_no_trace_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Trace.load(tmp_path / "missing.parquet")
    (tmp_path / "text.parquet").write_text("not parquet at all, but some text")
    with pytest.raises(InputError, match="not a readable Parquet file"):
        Trace.load(tmp_path / "text.parquet")
    pq.write_table(pa.table({"x": [1.0]}), tmp_path / "other.parquet")
    with pytest.raises(InputError, match="not a trace"):
        Trace.load(tmp_path / "other.parquet")
    make_trace().save(tmp_path / "whole.parquet")
    older = pq.read_table(tmp_path / "whole.parquet").drop_columns(["yaw_rate"])
    pq.write_table(older, tmp_path / "older.parquet")
    with pytest.raises(InputError, match=r"another version.*'yaw_rate'"):
        Trace.load(tmp_path / "older.parquet")
    cut = (tmp_path / "whole.parquet").read_bytes()[:-100]
    (tmp_path / "cut.parquet").write_bytes(cut)
    with pytest.raises(InputError, match=r"cut\.parquet"):
        Trace.load(tmp_path / "cut.parquet")
