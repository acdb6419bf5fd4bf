"""A run's folder that is dropped on the planner: what is taken, and what is refused."""

import base64
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from flcav.planner import server
from flcav.planner.desk import Desk
from flcav.planner.server import make_app

RUN = Path(server.__file__).parents[3] / "reproductions" / "runs" / "demo"


def packed(content: bytes) -> str:
    return base64.b64encode(content).decode()


@pytest.fixture
def page() -> TestClient:
    return TestClient(
        make_app(Desk(), "secret"), base_url="http://127.0.0.1", headers={"authorization": "Bearer secret"}
    )


def test_rounds_of_a_dropped_run_are_told(page):
    files = {"results.json": packed((RUN / "results.json").read_bytes())}
    answer = page.post("/api/drop-run", json={"name": "my run", "files": files})
    assert answer.status_code == 200, answer.text
    run = answer.json()["run"]
    assert (run["name"], len(run["moments"])) == ("my_run", 12)
    assert run["footage"] == {"regions": [], "sweep": False, "pictures": []}
    assert page.post("/api/start", json={}).json()["run"] == run


@pytest.mark.parametrize(
    "name",
    [
        "../results.json",
        "/etc/passwd",
        "work/../errors.parquet",
        "work/.a/errors.parquet",
        "work/a/b/errors.parquet",
        "work/a/weights.safetensors",
        "results.json\n",
    ],
)
def test_no_other_file_is_written(page, name):
    answer = page.post("/api/drop-run", json={"name": "run", "files": {name: packed(b"x")}})
    assert answer.status_code == 422
    assert "no file of a run that the planner reads" in answer.json()["error"]


@pytest.mark.parametrize(
    ("text", "said"), [("!", "base64"), (packed(b"{}"), "results.json"), (packed(b"["), "results.json")]
)
def test_what_is_no_run_is_refused_without_its_folder(page, text, said):
    answer = page.post("/api/drop-run", json={"name": "run", "files": {"results.json": text}})
    assert answer.status_code == 422
    assert said in answer.json()["error"]
    assert "/tmp" not in answer.json()["error"]


def test_a_run_without_rounds_is_refused(page):
    assert page.post("/api/drop-run", json={"name": "run", "files": {}}).status_code == 422
