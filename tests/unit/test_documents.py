"""Documents that are made to exhaust whoever reads them, and names in them that lead elsewhere."""

import tracemalloc
from pathlib import Path

import pytest

from flcav.config import DEEPEST, InputError, path_within, read_json, read_xml, read_yaml

TENFOLD = "".join(f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n" for before, name in zip("abcde", "bcdef"))
LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + TENFOLD  # 10^6 times x
MERGED = "a: &a {x: 1}\n" + TENFOLD.replace("[", "{<<: [").replace("]", "]}")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[" * 300_000 + "]" * 300_000, "nested more than 100 levels deep"),
        ("- " * 20_000 + "x", "nested more than 100 levels deep"),
        (LAUGHS, "its aliases stand for more than 100000 values"),
        (MERGED, "its aliases stand for more than 100000 values"),
        ("a: &a [1, *a]", "its aliases stand for more than 100000 values"),
        ("a: *b", "undefined alias"),
    ],
)
def test_yaml_that_unfolds_without_end_is_refused(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=rf"a\.yaml: not a YAML file \((.|\n)*{sentence}"):
            read_yaml(tmp_path / "a.yaml")
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_yaml_with_aliases_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: &a {x: 1}\nb: {<<: *a, y: [*a, *a]}\nc: &c 7\nd: [*c, *c]\n")
    one = {"x": 1}
    assert read_yaml(tmp_path / "a.yaml") == {"a": one, "b": {"x": 1, "y": [one, one]}, "c": 7, "d": [7, 7]}


@pytest.mark.parametrize(("depth", "read"), [(DEEPEST, True), (DEEPEST + 1, False), (900, False), (100_000, False)])
def test_nesting_has_an_end(depth: int, read: bool, tmp_path: Path) -> None:
    path = tmp_path / "deep"
    for text, reader in (
        ('[{"a": [1]}, ' + "[" * (depth - 2) + "1, []" + "]" * (depth - 2) + "]", read_json),
        ("[" * depth + "]" * depth, read_yaml),
        ("<a>" * depth + "</a>" * depth, lambda path: read_xml(path, "a map")),
    ):
        path.write_text(text)
        if read:
            reader(path)
        else:
            with pytest.raises(InputError, match=r"deep: not .* \((nested more than 100 levels|maximum recursion)"):
                reader(path)


def test_elements_beside_each_other_are_not_deep(tmp_path: Path) -> None:
    (tmp_path / "wide").write_text("<a>" + "<b><c/></b>" * 1000 + "</a>")
    assert len(read_xml(tmp_path / "wide", "a map")) == 1000


@pytest.mark.parametrize("name", ["a", "a/b.bin", "a.b/..c", "a\\b", "ä ö", ".hidden"])
def test_names_within_a_folder(name: str, tmp_path: Path) -> None:
    assert path_within(tmp_path, name, "list") == tmp_path / name


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "a/../../x", "/etc/passwd", "C:x", "C:\\x", "\\\\host\\x", "a\\..\\..\\x", "a\0b"]
)
def test_names_that_lead_out_of_a_folder(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"list: .* is no name of a file in "):
        path_within(tmp_path, name, "list")
