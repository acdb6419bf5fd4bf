"""Runs at toy scale, as a user has them: what the results, the report and the studies made of a run say."""

import html
import json
import re
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from toy_run import RECIPE, TOY, Studied

from flcav.cli.main import run as command
from flcav.cli.pictures import open_shown
from flcav.dataset.store import Dataset
from flcav.perception.errors import load_errors
from flcav.report.run_tables import judge_anew
from flcav.reproductions.demo_arms.run import ARMS
from flcav.reproductions.fig6a_allocation.findings import MEAN
from flcav.reproductions.placement.records import COVERAGE, NEAR, TOWN, TRAFFIC
from flcav.reproductions.placement.run import prove_placement
from flcav.runs.frames import Frames
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import Run, Summary
from flcav.runs.results.saved import ERRORS
from flcav.runs.results.tests import ErrorsAfter
from flcav.runs.results.training import StageResult, Watched
from flcav.runs.stages.graph import Graph
from flcav.statistics.verdicts import ESTIMATE, UNDECIDED, verdict
from flcav.world.map.town import load_town

pytestmark = pytest.mark.slow


def test_every_arm_region_and_task_has_its_measure(result: Run) -> None:
    tested = {(test.arm, test.stage, test.region) for test in result.tested}
    assert {(MAIN, stage, region) for stage in (PRETRAIN, CLOUD) for region in RECIPE.regions} <= tested
    assert {(MAIN, EDGE, "grid"), (MAIN, EDGE, "ring"), ("densest", EDGE, "grid")} <= tested
    assert {("more", CENTRAL, "grid"), ("more", CENTRAL, "ring"), ("oracle", CENTRAL, "grid")} <= tested
    assert ("equal", CLOUD, "suburb") in tested
    for test in result.tested:
        low, high = test.result.estimate.low, test.result.estimate.high
        assert low is not None
        assert high is not None
        assert 0 <= low <= test.result.estimate.mean <= high <= 1
        assert (test.result.frames, test.result.scenes) == (6, 3)
        assert "AP70" in test.result.numbers


def test_sensors_stand_where_most_errors_or_most_traffic_is(result: Run) -> None:
    (placed,) = (each for each in result.arms[MAIN].placed if each.region == "grid")
    assert [pole.pole for pole in placed.poles] == load_town("grid").poles.id.tolist()
    assert placed.covered == max(pole.covered for pole in placed.poles) <= placed.errors
    assert result.arms["densest"].placed[0].chosen == (placed.densest,)


def test_gains_of_a_pole_are_those_of_its_own_arm_over_the_run_itself(studied: Studied, result: Run) -> None:
    proof = prove_placement(RECIPE, [result], [studied[0] / "seed1" / "work"])
    (seed,), sites = proof.regions["grid"].seeds, result.arms[MAIN].placed[0].poles
    (pole,), (site,) = seed.poles, (each for each in sites if each.pole == 8)
    reached = [result.test(arm=arm, stage=EDGE, region="grid", task="objects").estimate.mean for arm in ("pole8", MAIN)]
    assert result.arms["pole8"].placed[0].chosen == (pole.pole,) == (8,)
    assert (pole.predictors[COVERAGE], pole.predictors[TRAFFIC]) == (site.covered, site.actors)
    assert seed.without[TOWN] == reached[1]
    assert pole.gain[TOWN] == pytest.approx(reached[0] - reached[1])
    assert set(pole.gain) == {TOWN, NEAR}
    assert list(proof.regions) == ["grid"]  # no arm has a single pole in `ring`


def test_place_compares_with_the_traffic_of_a_dataset_and_sees_no_errors_behind_houses(
    finished: Path, result: Run, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    town, (x, y) = load_town("grid"), np.meshgrid(*2 * [np.arange(-100, 101, 10)])
    lattice = "\n".join(f"{i},{j},1" for i, j in zip(x.ravel(), y.ravel()))
    (tmp_path / "errors.csv").write_text(f"x,y,z\n{lattice}\n")
    rows = (f"{number},{i},{j},{z}" for number, (i, j, z) in zip(town.poles.id, town.poles.position))
    (tmp_path / "poles.csv").write_text("\n".join(("id,x,y,z", *rows)))
    files = ["--errors", str(tmp_path / "errors.csv"), "--poles", str(tmp_path / "poles.csv")]
    asked = [*files, "--range", "40", "--count", "1", "--data", str(finished / "work/grid-registry-objects/data")]
    told = []
    for more in ([], ["--line-of-sight"]):
        with pytest.raises(SystemExit) as stopped:
            command(["place", *asked, *more, "--json"])
        assert not stopped.value.code
        told.append(json.loads(capsys.readouterr().out))
    whole, seen = told
    apart = np.linalg.norm(np.c_[x.ravel(), y.ravel(), np.ones(x.size)] - town.poles.position[:, None], axis=2)
    assert whole["covered"] == (apart <= 40).sum(axis=1).max()
    assert 0 < seen["covered"] < whole["covered"]
    (densest,) = result.arms["densest"].placed[0].chosen
    assert whole["baselines"]["traffic-density"]["chosen"] == [{"pole": densest, "sensor": None}]
    for each in told:
        for name in ("traffic-density", "visible-objects"):
            assert 0 < each["baselines"][name]["covered"] <= each["covered"]


def test_central_arms_take_as_many_steps_as_stage_two_on_their_own_samples(finished: Path, result: Run) -> None:
    pretrained, plan = result.pretrained[0], result.arms[MAIN].plan.tasks["objects"]
    steps = ("central-objects-more", "grid-central-objects-oracle")
    more, oracle = (StageResult.load(finished / "work" / step) for step in steps)
    edge = StageResult.load(finished / "work/grid-edge-fl-objects")
    assert more.samples == sum(map(len, pretrained.uploaded.values())) == plan.samples
    assert oracle.samples == edge.samples
    assert more.rounds == oracle.rounds == edge.rounds == plan.edge_rounds == 2


def test_vehicles_learn_from_what_is_near_a_sensor_of_any_arm(finished: Path, result: Run) -> None:
    split = Frames.open(finished / "work/grid-edge-objects")
    places = [Placed.load(folder) for folder in (finished / "work").glob("grid-place*")]
    poles = load_town("grid").poles
    sites = [poles.position[poles.id.tolist().index(pole), :2] for placed in places for pole in placed.chosen]
    near = [
        i
        for i in split.vehicles
        if min(np.hypot(*(split.data.frame(i).world_from_agent[:2, 3] - site)) for site in sites)
        <= RECIPE.placement.group_range_m
    ]
    assert StageResult.load(finished / "work/grid-edge-fl-objects").samples == len(near)
    assert set(split.poles) == {pole for placed in places for pole in placed.chosen}


def test_no_two_splits_share_a_scene(finished: Path) -> None:
    folders = sorted(finished.glob("work/*/data"))
    assert len(folders) == 3 + 4 + 4
    scenes = [{key.scene for key in Dataset.open(folder).keys} for folder in folders]
    assert not any(a & b for a, b in combinations(scenes, 2))


def test_the_plan_is_made_anew_from_what_the_run_reached_and_sent(finished: Path, result: Run) -> None:
    main = result.arms[MAIN]
    assert main.earlier is not None
    assert [plan.after for plan in (*main.earlier, main.plan)] == [None, PRETRAIN, EDGE]
    for plan in (*main.earlier[1:], main.plan):
        frames, scores = zip(
            *((each.frames, each.rounds[-1].score) for each in result.watched if each.stage == plan.after), strict=True
        )
        assert plan.reached == {"objects": pytest.approx(np.average(scores, weights=frames))}
    (own,) = (each for each in main.plan.tasks.values())
    assert len(Watched.load(finished / "work/rounds-grid-edge-fl-objects-grid").rounds) == own.edge_rounds
    assert result.arms["equal"].earlier is None


def test_rounds_are_watched_on_validation_frames(finished: Path, result: Run) -> None:
    graph = Graph(RECIPE, TOY.parent)
    for step in graph.steps:
        if step.name.startswith("rounds-"):
            assert "-validation-" in step.arguments["settings"].frames
    assert {(each.stage, each.region) for each in result.watched} == {
        (s, r) for s in (PRETRAIN, EDGE, CLOUD) for r in ("grid", "ring")
    }
    watched = Watched.load(finished / "work/rounds-grid-edge-fl-objects-grid")
    assert [each.round for each in watched.rounds] == [1, 2]


def test_findings_say_what_their_intervals_say(result: Run) -> None:
    own = [each for each in result.differences if each.arm == MAIN]
    assert len(own) == len(result.findings) >= 8
    for difference, finding in zip(own, result.findings, strict=True):
        low, high = difference.estimate.low, difference.estimate.high
        assert low is not None
        assert high is not None
        lost = " lose to " in finding.question  # an estimate, no claim
        assert finding.verdict in ((ESTIMATE,) if lost else (UNDECIDED, verdict(low, high)))
        if "nothing to compare" not in finding.sentence:
            assert f"{difference.estimate.mean:+.3f}".replace("-", "−") in finding.sentence

    assert judge_anew(result) == result.findings


def test_the_report_needs_no_other_file(finished: Path, result: Run) -> None:
    text = (finished / "report.html").read_text()
    assert all(
        link.startswith(("data:", "#")) for link in re.findall(r"""(?:src|xlink:href)\s*=\s*["']?([^"'\s>]+)""", text)
    )
    files = re.findall(r' href="([^"#]+)"', text)
    assert all((finished / file).exists() for file in files)  # of the run's folder: results, pictures
    assert not re.search(r"url\((?!#)|@import|<script[^>]+src|<link|<iframe", text)
    read = html.unescape(re.sub(r"\s+", " ", text))
    assert all(finding.sentence in read for finding in result.findings)
    names = {path.stem for path in (finished / "pictures").iterdir()}
    timelines = {"timeline_grid_equal", "timeline_ring_equal"}
    drawn = {"map_grid", "map_ring", "rounds_objects", "megabytes", "gain", "before_after", "overview"}
    assert names == drawn | timelines
    for path in (finished / "pictures").iterdir():
        with Image.open(path) as picture:
            assert min(picture.size) > 300
            colours = picture.convert("RGB").resize((300, 300)).getcolors(90_000)
            assert colours is not None
            assert len(colours) > 50, path.name


def test_the_loop_of_a_run_is_an_animation(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        command(["view", str(finished), "--animate", str(tmp_path / "loop.webp")])
    assert not stopped.value.code
    assert "96 frames, 8 s" in capsys.readouterr().out
    with Image.open(tmp_path / "loop.webp") as film:
        assert getattr(film, "n_frames", 1) > 40
        assert film.size == (960, 540)


def test_the_run_leaves_history_that_fit_reads(studied: tuple[Path, Any, Any], capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        command(["fit", str(studied[0] / "history.csv"), "--json", "--repeats", "20"])
    assert not stopped.value.code
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert curve["points"] == 1 + 2 + 1  # pretrained, each edge round, each cloud round


def test_the_comparison_of_arms_is_that_of_the_run(studied: Studied, result: Run) -> None:
    results = studied[1]
    (seed,) = results.seeds
    for town, arms in ARMS.items():
        for name, (arm, stage) in arms.items():
            test = result.test(arm=arm, stage=stage, region=town, task="objects")
            assert seed.ap[town][name].ap50 == test.estimate.mean
    assert set(seed.gap_closed) == set(ARMS["grid"]) - {"pretrained", "oracle"}
    assert len(seed.differences) == 7 + 4
    assert seed.used_mb["edge + cloud FL"]["wireless"] == result.arms[MAIN].links["wireless"].used_mb
    further, main = result.arms["further"], result.arms[MAIN]
    assert further.links["wireless"].used_mb == main.links["wireless"].used_mb  # an edge round instead of a cloud round
    assert further.links["wireline"].used_mb == pytest.approx(
        sum(each.mb for each in main.spent if (each.stage, each.link) == (PRETRAIN, "wireline"))
    )
    rounds = [each.rounds for each in further.stages if each.stage == MORE_EDGE]
    assert rounds == [main.plan.tasks["objects"].cloud_rounds] * 2
    assert results.summary.ap50["grid"]["oracle"].mean == seed.ap["grid"]["oracle"].ap50


def test_the_proof_by_training_compares_two_plans(studied: Studied, result: Run) -> None:
    (at,) = studied[2].budgets
    (seed,) = at.seeds
    equal, joint = seed.plans["equal-stages"], seed.plans["joint"]
    assert joint.samples == result.arms[MAIN].plan.tasks["objects"].samples
    assert equal.samples == result.arms["equal"].plan.tasks["objects"].samples
    first, *made_anew = result.arms[MAIN].plans  # those made anew rest on scores of the run
    assert made_anew
    assert seed.predicted["joint"] == first.tasks["objects"].predicted
    assert set(seed.realised) == set(seed.differences) == {MEAN, "grid", "ring"}
    towns = [seed.realised[town]["joint"][EDGE].ap50 for town in ("grid", "ring")]
    assert seed.realised[MEAN]["joint"][EDGE].ap50 == pytest.approx(np.mean(towns))
    assert (joint.counts, at.coincide) == (equal.counts, True)  # the limits of the toy's rounds bind both
    assert ["the same" in finding.sentence for finding in at.findings] == [True, False]


def test_the_summary_of_seeds_is_beside_them(studied: tuple[Path, Any, Any]) -> None:
    summary = json.loads((studied[0] / Summary.file).read_text())
    assert summary["seeds"] == [1]
    assert {claim["held"] + claim["did_not_hold"] + claim["undecided"] for claim in summary["claims"]} == {1}
    assert {row["name"] for row in summary["gap_closed"]} >= {"grid, objects: edge FL"}
    judged = {row["name"] for row in summary["differences"] if "judged" in row}
    assert "grid, objects: edge + cloud FL - further edge FL" in judged
    assert "grid, objects: central training (more) - pretrained" not in judged


def test_the_viewer_shows_the_test_frames_of_a_run(finished: Path, result: Run) -> None:
    shown = open_shown(finished)
    assert shown.folder == finished / "work" / "grid-test-objects" / "data"
    assert open_shown(shown.folder).folder == shown.folder


def test_what_became_of_the_errors_agrees_with_their_registry(finished: Path, result: Run) -> None:
    for region in ("grid", "ring"):
        registered = load_errors(finished / "work" / f"{region}-errors-objects" / ERRORS)
        after = ErrorsAfter.load(finished / "work" / f"{region}-errors-after-objects")
        assert len(after.remains) == len(registered)
        assert len(after.new) == len(after.new_kinds)
    assert result.counts is not None
    assert [(row.arm, row.stage, row.region) for row in result.counts] == [
        (test.arm, test.stage, test.region) for test in result.tested
    ]
    for row, test in zip(result.counts, result.tested, strict=True):
        assert row.targets == test.result.numbers["targets"]
        assert row.found <= row.targets
