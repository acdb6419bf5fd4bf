"""Tables of nuScenes are read row by row: the same rows as of the whole file, and no more in memory than is kept."""

import json
import tracemalloc
from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.dataset.formats.nuscenes import tables
from flcav.dataset.formats.nuscenes.tables import read_rows_by_token, stream_table

NAMES = ['a "quoted" one', "ends in \\", "brackets ]},{[", "überall", "", "1e5", "a\nb"]


def _write(folder: Path, text: str) -> Path:
    (folder / "category.json").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize("chunk", [1, 2, 7, 64, 1 << 20])
@pytest.mark.parametrize("layout", [{}, {"indent": 1}, {"separators": (",", ":"), "ensure_ascii": False}])
def test_rows_are_those_of_the_file_read_at_once(
    chunk: int, layout: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tables, "CHUNK", chunk)
    table = [{"token": str(n), "name": name, "index": [n, {"deep": [1.5, -2]}]} for n, name in enumerate(NAMES)]
    folder = _write(tmp_path, f" \n{json.dumps(table, **layout)}\n ")  # type: ignore[arg-type]
    read = json.loads((folder / "category.json").read_text(encoding="utf-8"))
    assert list(stream_table(folder, "category")) == [{"name": row["name"], "token": row["token"]} for row in read]
    assert read_rows_by_token(_write(tmp_path, "[ ]"), "category") == {}


@pytest.mark.parametrize("chunk", [3, 1 << 20])
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "not JSON"),
        ("[", "not JSON"),
        ("tables", "not JSON"),
        ("{}", "a list of rows is wanted"),
        ("12", "a list of rows is wanted"),
        ('[{"token": "a", "name": "b"}', "not JSON"),
        ('[{"token": "a", "name": "b"},]', "not JSON"),
        ('[{"token": "a", "name": "b"} {}]', "not JSON"),
        ('[{"token": "a", "name": "b"}] []', "not JSON"),
        ('[{"token": "a", "name": "b"}, 12]', "row 1 has no 'token'"),
        ('[{"token": "a"}]', "row 0 has no 'name'"),
        ('[{"token": "a", "name": 12}]', "row 0 has a 'name' that is none: 12"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_what_is_no_table_is_one_sentence(
    text: str, sentence: str, chunk: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tables, "CHUNK", chunk)
    with pytest.raises(InputError, match=sentence) as error:
        read_rows_by_token(_write(tmp_path, text), "category")
    assert str(error.value).startswith(f"{tmp_path / 'category.json'}: ")


def test_memory_is_that_of_the_rows_that_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tables, "CHUNK", 1 << 14)
    table = [{"token": f"{n:032d}", "name": f"{n:064d}", "description": "x" * 200} for n in range(3000)]
    folder = _write(tmp_path, json.dumps(table))
    tracemalloc.start()
    found = read_rows_by_token(folder, "category", lambda row: row["token"].endswith("00"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found) == 30
    assert peak < (folder / "category.json").stat().st_size / 4
