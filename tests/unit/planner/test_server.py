"""The planner's server: who is answered, what is refused, in a sentence."""

import json
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from flcav.optimization.graph import load_problem
from flcav.planner import server
from flcav.planner.desk import Desk, lay_out
from flcav.planner.planning import plan_budgets, plan_more, with_budgets
from flcav.planner.server import make_app
from flcav.world.map.town import load_town

HOLDER = {"authorization": "Bearer secret"}
KIND = {"name": "sensor", "range_m": 40}
TABLE = b"x,y\n-60,15\n50,10\n-61,14\n"
PROBLEM = Path(server.__file__).parents[3] / "recipes" / "allocation" / "objects.yaml"


@pytest.fixture(scope="module")
def desk() -> Desk:
    desk = Desk(problem=load_problem(PROBLEM), problem_name="objects.yaml")
    desk.first = desk.add(lay_out(load_town("suburb")))
    return desk


@pytest.fixture(scope="module")
def page(desk) -> TestClient:
    return TestClient(make_app(desk, "secret"), base_url="http://127.0.0.1", headers=HOLDER)


@pytest.fixture(scope="module")
def key(page) -> str:
    answer = page.post("/api/drop?name=seen.csv&workspace=suburb", content=TABLE)
    assert answer.status_code == 200, answer.text
    return answer.json()["key"]


def test_the_page_asks_no_other_host(page):
    answer = page.get("/")
    assert answer.status_code == 200
    assert "connect-src 'self'" in answer.headers["content-security-policy"]
    for name in ("", "planner.js", "planner.css", "scene.js"):
        text = page.get(f"/{name}").text
        for scheme in ("http:", "https:", "//"):
            hosts = [part.split('"')[0] for part in text.split(f'"{scheme}')[1:]]
            assert [host for host in hosts if not host.startswith("//www.w3.org/")] == []


@pytest.mark.parametrize(
    "headers", [{}, {"authorization": ""}, {"authorization": "Bearer secre"}, {"authorization": "secret"}]
)
def test_nobody_is_answered_without_the_token(desk, headers):
    asked = TestClient(make_app(desk, "secret"), base_url="http://127.0.0.1", headers=headers)
    answer = asked.post("/api/start", json={})
    assert (answer.status_code, [*answer.json()]) == (401, ["error"])


@pytest.mark.parametrize(
    "route",
    ["open", "workspace", "drop?name=a.csv", "look", "best", "curve", "new-poles", "export", "plan", "plan-more"],
)
def test_every_question_needs_the_token(desk, route):
    stranger = TestClient(make_app(desk, "secret"), base_url="http://127.0.0.1")
    assert stranger.post(f"/api/{route}", json={}).status_code in (401, 422)
    assert "error" in stranger.post(f"/api/{route}", json={}).json()


def test_pages_of_other_sites_and_other_names_of_this_host_are_refused(page):
    assert page.post("/api/start", json={}, headers={"origin": "http://127.0.0.1"}).status_code == 200
    assert page.post("/api/start", json={}, headers={"origin": "https://example.org"}).status_code == 403
    assert page.post("/api/start", json={}, headers={"host": "example.org"}).status_code == 400


@pytest.mark.parametrize(
    "name", ["../server.py", "%2e%2e%2fserver.py", "..%2f..%2fpyproject.toml", "index.html/x", "etc"]
)
def test_no_path_leads_out_of_the_pages(page, name):
    assert page.get(f"/{name}").status_code == 404


@pytest.mark.parametrize("town", ["..", "/", "../suburb", "atlantis", "suburb/../grid", "\x00"])
def test_towns_are_no_paths(page, town):
    answer = page.post("/api/open", json={"town": town})
    assert answer.status_code == 422
    assert answer.json()["error"].startswith("there is no town")


def test_uploads_are_read_by_their_ending_and_leave_no_path(page):
    for name in ("../../../errors.csv", "errors.csv", "a/b/errors.CSV"):
        answer = page.post("/api/drop", params={"name": name, "workspace": "suburb"}, content=TABLE)
        assert answer.json()["table"].lower() == "errors.csv"
    for name in ("errors", "x.exe", "x.yaml", ".csv/.."):
        answer = page.post("/api/drop", params={"name": name, "workspace": "suburb"}, content=TABLE)
        assert answer.status_code == 422
        assert "is wanted" in answer.json()["error"]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "errors.csv: "),
        (b"a,b\n1,2\n", "column 'x' is missing"),
        (b"x,y\n1,far\n", "is not a finite number"),
        (b"x,y\n1e9,0\n", "far from suburb"),
        (b"\x00\xff\xfe", "errors.csv"),
    ],
)
def test_wrong_tables_are_told_in_a_sentence(page, content, sentence):
    answer = page.post("/api/drop?name=errors.csv&workspace=suburb", content=content)
    assert answer.status_code == 422
    assert sentence in answer.json()["error"]
    assert "/" not in answer.json()["error"].split("errors.csv")[0]


def test_a_table_needs_a_town(page):
    assert "open a town first" in page.post("/api/drop?name=errors.csv", content=TABLE).json()["error"]


def test_what_is_no_map_is_told(page):
    answer = page.post("/api/drop?name=x.xodr", content=b"<nothing/>")
    assert (answer.status_code, answer.json()["error"].startswith("x.xodr")) == (422, True)


def test_uploads_have_a_limit(page, monkeypatch):
    monkeypatch.setattr(server, "MOST_BYTES", 1000)
    whole = page.post("/api/drop?name=a.csv&workspace=suburb", content=b"x" * 1001)
    assert whole.status_code == 413
    parts = page.post("/api/drop?name=a.csv&workspace=suburb", content=(b"x" * 100 for _ in range(11)))
    assert parts.status_code == 413  # chunked: its length is not told


@pytest.mark.parametrize(
    ("route", "body"),
    [
        ("look", {"workspace": "suburb", "range_m": 0}),
        ("look", {"workspace": "suburb", "range_m": "far"}),
        ("look", {"workspace": "suburb", "range_m": 40, "x": 1e308}),
        ("look", {"workspace": "suburb", "range_m": 40, "pole": 99}),
        ("look", {"workspace": "nowhere", "range_m": 40}),
        ("look", {"workspace": "suburb", "range_m": 40, "more": 1}),
        ("best", {"workspace": "suburb", "kinds": [KIND], "count": 1}),  # no errors
        ("best", {"workspace": "suburb~seen", "kinds": [KIND]}),
        ("best", {"workspace": "suburb~seen", "kinds": [], "count": 1}),
        ("best", {"workspace": "suburb~seen", "kinds": [KIND], "count": 99}),
        ("best", {"workspace": "suburb~seen", "kinds": [KIND | {"cost": 3}], "budget": 1}),
        ("best", {"workspace": "suburb~seen", "kinds": [KIND], "count": 1, "without": ["point"]}),
        ("new-poles", {"workspace": "suburb~seen", "kinds": [KIND], "kind": 4, "uncovered": [0]}),
        ("new-poles", {"workspace": "suburb~seen", "kinds": [KIND], "kind": 0, "uncovered": [9]}),
        ("export", {"workspace": "suburb~seen", "kinds": [KIND], "pairs": [[9, 0]]}),
        ("plan", {"wireless_mb": 0, "wireline_mb": 1}),
        ("plan", {"wireless_mb": "NaN", "wireline_mb": 1}),
    ],
)
def test_wrong_questions_are_told_in_a_sentence(page, key, route, body):
    assert key == "suburb~seen"
    answer = page.post(f"/api/{route}", json=body)
    assert answer.status_code == 422
    told = answer.json()["error"]
    assert told
    assert "\n" not in told
    assert "Traceback" not in told


def test_a_body_that_is_no_json_is_told(page):
    answer = page.post("/api/best", content=b"{")
    assert (answer.status_code, "error" in answer.json()) == (422, True)


def test_a_sensor_sees_the_table_that_was_dropped(page, key):
    first = page.post("/api/look", json={"workspace": key, "pole": 0, "range_m": 40}).json()
    assert first["covered"] == [0, 2]
    own = page.post("/api/look", json={"workspace": key, "x": 50, "y": 12, "range_m": 20}).json()
    assert (own["covered"], own["z"]) == ([1], 6.0)
    best = page.post("/api/best", json={"workspace": key, "kinds": [KIND], "count": 2}).json()
    assert (best["covered"], best["bound"], best["optimal"]) == (3, 3.0, True)


def test_a_plan_is_that_of_allocate(page):
    asked = {"wireless_mb": 4000, "wireline_mb": 4000}
    problem = load_problem(PROBLEM)
    assert page.post("/api/plan", json=asked).json() == json.loads(json.dumps(plan_budgets(problem)))
    less = plan_budgets(with_budgets(problem, 2000, 4000, None))
    assert less["objective"] > plan_budgets(problem)["objective"]  # pyright: ignore[reportOperatorIssue]


def test_savings_are_solved_anew():
    problem = load_problem(PROBLEM)
    plan, more = plan_budgets(problem), plan_more(problem)
    richer = plan_budgets(with_budgets(problem, 4400, 4000, None))
    saved = next(each for each in more["savings"] if (each["link"], each["added"]) == ("wireless", 0.1))  # type: ignore
    assert saved["saved"] == pytest.approx(plan["objective"] - richer["objective"])  # type: ignore


def test_budgets_that_allow_no_plan_are_told(page):
    told = page.post("/api/plan", json={"wireless_mb": 1, "wireline_mb": 1}).json()
    assert [*told] == ["infeasible"]
    assert "MB" in told["infeasible"]
