"""Parquet files that unfold to far more than tables do."""

import resource
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.storage.files import read_parquet


def test_a_table_that_would_fill_the_memory_is_not_read(tmp_path: Path) -> None:
    rows = 60_000_000  # eight bytes each, written as the length of one run
    pq.write_table(pa.table({"a": pa.array(np.zeros(rows, np.int64))}), tmp_path / "a.parquet", row_group_size=rows)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"a\.parquet: not a readable Parquet file \(it would take 480000000 bytes"):
        read_parquet(tmp_path / "a.parquet")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # [kB]


def test_a_table_of_equal_rows_is_read(tmp_path: Path) -> None:
    table = pa.table({"a": np.zeros(1_000_000), "b": ["x"] * 1_000_000, "c": [[1, 2]] * 1_000_000})
    pq.write_table(table, tmp_path / "a.parquet")
    assert read_parquet(tmp_path / "a.parquet").equals(table)
