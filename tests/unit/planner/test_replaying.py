"""A finished run, moment by moment: its sums are those of the ledger."""

import json
import shutil
from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.planner import replaying
from flcav.planner.replaying import open_run

RUN = Path(replaying.__file__).parents[3] / "reproductions" / "runs" / "demo"


def test_the_last_moment_holds_what_the_ledger_holds():
    run = open_run(RUN).run
    assert run is not None
    moments = run["moments"]
    links = json.loads((RUN / "results.json").read_text())["arms"]["main"]["links"]
    for link, use in links.items():
        assert moments[-1]["sent"][link] == pytest.approx(use["used_mb"])  # type: ignore
        sent = [moment["sent"][link] for moment in moments]  # type: ignore
        assert sent == sorted(sent)
    assert [moment["told"] for moment in moments][:2] == ["pretraining", "edge round 1"]  # type: ignore


def test_errors_of_a_run_are_put_on_its_regions_map(tmp_path):
    shutil.copy(RUN / "results.json", tmp_path)
    step = tmp_path / "work" / "grid-errors-objects"
    step.mkdir(parents=True)
    errors = "x,y,z,weight,kind,class,returns,occlusion,scene,track\n1,2,0.8,1,miss,Car,3,0.5,s,t\n"
    (step / "errors.csv").write_text(errors)
    import pyarrow.csv
    import pyarrow.parquet as pq

    pq.write_table(pyarrow.csv.read_csv(step / "errors.csv"), step / "errors.parquet")
    desk = open_run(tmp_path)
    assert desk.first == "grid~grid"
    assert len(desk.find("grid~grid").errors) == 1


def test_another_folder_is_refused(tmp_path):
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(InputError):
        open_run(tmp_path)
