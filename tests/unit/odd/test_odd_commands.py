"""The commands of domains: what they print, and what they refuse in a sentence."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.csv
import pytest

from flcav.cli.main import run
from flcav.dataset.store import Dataset
from flcav.odd.domain import read_domain
from flcav.odd.measure import measure_domain
from flcav.perception.networks import register_errors


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        run(["odd", *arguments])
    told = capsys.readouterr()
    assert ended.value.code == 0, told.err
    return told.out


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        run(["odd", *arguments])
    told = capsys.readouterr()
    assert (ended.value.code, told.out, told.err.count("\n")) == (2, "", 1)
    return told.err


def test_check_says_what_is_unknown(capsys: pytest.CaptureFixture[str], odd_file):
    found = json.loads(answer(capsys, "check", "mine", "--town", "ring", "--json"))
    parts = {part["attribute"]: part["realised"] for part in found["parts"]}
    assert parts["scenery.zone"] is None
    assert parts["scenery.surface_type"] is False
    assert parts["scenery.speed_limit"] is True
    own = odd_file("TAXONOMY: {wind: float velocity}\nMODULES: {m: {INCLUDE_AND: {wind: '<= 5 m/s'}}}")
    assert "unknown: nothing in the binding measures it" in answer(capsys, "check", str(own), "--town", "ring")


def test_check_of_a_recording_counts_its_frames(drive: Dataset, capsys: pytest.CaptureFixture[str]):
    found = json.loads(answer(capsys, "check", "urban", "--data", str(drive.folder), "--json"))
    for part in found["parts"]:
        assert part["inside"] + part["outside"] + part["unknown"] == len(drive)


def test_inside_writes_the_verdict_of_each_frame(drive: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    table = tmp_path / "frames.csv"
    found = json.loads(answer(capsys, "inside", str(drive.folder), "urban", "--frames", str(table), "--json"))
    rows = pyarrow.csv.read_csv(table).to_pylist()
    assert [row["frame"] for row in rows] == [drive.name(i) for i in range(len(drive))]
    assert [row["verdict"] for row in rows].count("inside") == found["inside"]


def test_of_prints_spans_and_writes_tables(drive: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    found = json.loads(answer(capsys, "of", str(drive.folder), "--out", str(tmp_path / "cod"), "--json"))
    assert found["rows"] == found["frames"] == len(drive)
    assert {span["attribute"]: span["words"] for span in found["attributes"]}["surface_type"] == {"asphalt": len(drive)}


def test_cover_writes_its_report(drive: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "covered"
    printed = json.loads(answer(capsys, "cover", "urban", "--data", str(drive.folder), "--out", str(out), "--json"))
    assert json.loads((out / "coverage.json").read_text()) == printed
    assert printed["runs"] == 4
    domain, by = read_domain("urban"), set(printed["by"])
    grades = {row["attribute"]: row["grade"] for row in printed["attributes"]}
    assert set(grades) <= {*domain.tested, *by}
    assert len(grades) > len(by)
    assert printed["grade"] == pytest.approx(np.mean(list(grades.values())))
    assert printed["cells"] == []
    told = answer(capsys, "cover", "urban", "--data", str(drive.folder), "--out", str(out))
    page = (out / "matrix.html").read_text()
    cells = f"{printed['covered_cells']} / {printed['inside_cells']} cells"
    assert f'>{printed["covered_cells"] / printed["inside_cells"]:.0%}</span><span class="oo-s">{cells}<' in page
    for sentence in (told.splitlines()[0], told.splitlines()[-1].removeprefix(f"{out / 'matrix.html'}: ")):
        assert f"<p>{sentence}</p>" in page


def test_cover_says_where_the_detector_errs(drive: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, out = str(drive.folder), str(tmp_path / "covered")
    told = answer(
        capsys, "cover", "urban", "--data", folder, "--out", out, "--by", "junction,light", "--detect", "--json"
    )
    found = json.loads(told)
    measured = measure_domain(drive)
    seen = Counter(zip(measured.columns["junction"].tolist(), measured.columns["light"].tolist(), strict=True))
    assert {tuple(cell["cell"]): cell["frames"] for cell in found["cells"]} == dict(seen)
    errors = register_errors("objects", drive, agents="vehicles")
    assert sum(cell["errors"] for cell in found["cells"]) >= len(errors) > 0
    failed = sum(cell["failures"] for cell in found["cells"])
    outcomes = [json.loads(path.read_text())["outcome"] for path in (tmp_path / "covered" / "runs").iterdir()]
    assert (failed > 0) == any(not outcome["passed"] for outcome in outcomes)


@pytest.mark.parametrize("text", ["{", "[]", '{"odd": {}}', '{"odd": {}, "schema": "x", "items": 3}'])
def test_damaged_coverage_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "a_coverage.json").write_text(text)
    told = refusal(
        capsys, "sample", "urban", "--town", "ring", "--covered", str(tmp_path), "--out", str(tmp_path / "drawn")
    )
    assert "coverage" in told
    assert not (tmp_path / "drawn").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("check", "urbn"), "did you mean 'urban'"),
        (("check", "nothing.yaml"), "no such file"),
        (("check", "urban", "--town", "atlantis"), "unknown town"),
        (("check", "urban", "--town", "ring", "--data", "none"), "one of the two at most"),
        (("inside", "nowhere", "urban"), "nowhere"),
        (("inside", "nowhere", "urban", "--weather", "w.safetensors"), "has no use for --weather"),
        (("cover", "urban", "--data", "none", "--out", "out", "--by", "light"), "two attributes are wanted"),
        (("cover", "urban", "--data", "none", "--out", "out", "--range", "9"), "has no use for --range"),
        (("sample", "urban", "--out", "out", "--method", "lhs", "--covered", "here"), "has no use for --covered"),
        (("sample", "urban", "--out", "out", "--covered", "here"), "there are no runs in it"),
        (("tasks", "--data", "none", "--out", "run.json"), "a run recipe is a YAML file"),
    ],
)
def test_bad_input_is_refused_in_one_sentence(
    arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str], tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert said in refusal(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []
