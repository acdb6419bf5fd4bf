"""The recipe of the run on the radio, small: stragglers, plans between stages, planned uploads."""

from collections import Counter
from pathlib import Path

import pytest

from flcav.cli.main import run as command
from flcav.network.clock.records import ClientTiming, load_rounds
from flcav.network.ledger import Ledger
from flcav.report.pages.run_page import Seen, draw
from flcav.report.run_tables import tables
from flcav.runs.driving import TOO_SLOW
from flcav.runs.edge_stage import TRAIN_TIMES, Federations, name_results
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN, RunRecipe, Training, load_run_recipe
from flcav.runs.results.run import Run
from flcav.runs.running import SPREAD, run
from flcav.runs.training.timing import TrainTimes

pytestmark = pytest.mark.slow

RECIPE = Path(__file__).parents[2] / "recipes/runs/radio.yaml"
QUICK = Training(steps=1, local_steps=1)
TIMELY = {"rule": "deadline", "deadline_s": 6.6}


@pytest.fixture(scope="module")
def radio(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunRecipe, Run]:
    """Return the folder of the run, small and with an arm of deadline selection, its recipe, and what it gave."""
    asked = load_run_recipe(RECIPE).model_dump()
    few = {"scenes": 1, "spins": 3, "cavs": 1}
    asked["splits"] = {
        **{"pool": few | {"cavs": 2}, "validation": few, "edge": few, "registry": few | {"cavs": 4, "every_s": 2.0}},
        "test": {"scenes": 2, "spins": 1, "cavs": 1},
    }
    asked["regions"]["grid"]["speed"] = {"cav1": 0.5, "cav3": 0.3}  # cav3 trains for longer than the deadline
    asked["budgets_mb"]["wireless"] = 6.97  # three rounds, and most of one more
    asked["arms"] = {"timely": {"federation": asked["federation"] | {"selection": TIMELY}}}
    limits = {"samples": [3, 3], "edge_rounds": [2, 3], "cloud_rounds": [1, 3]}
    asked |= {"retrainings": 1, "training": QUICK, "limits": limits, "horizon_s": 24.0}
    recipe, out = RunRecipe.model_validate(asked), tmp_path_factory.mktemp("radio")
    return out, recipe, run(recipe, out)


def test_on_the_radio_stragglers_join_what_the_plan_gives_them_and_are_cut_off_at_the_deadline(
    radio: tuple[Path, RunRecipe, Run],
) -> None:
    folder, recipe, result = radio
    assert recipe.federation.network is not None
    deadline_s = recipe.federation.network.rounds.deadline_s
    assert deadline_s is not None
    joins = result.arms[MAIN].plan.tasks["weather"].joins
    assert joins is not None
    assert len(joins["grid/cav3"]) == 2 < len(joins["grid/cav0"])  # 24 s are no three rounds of 6.7 s and more
    outcomes: dict[str, list[ClientTiming]] = {name: [] for name in joins}
    lengths: dict[str, float] = dict.fromkeys(joins, 0.0)
    for step in ("{}-edge-fl-weather", "cloud-fl-weather"):
        for region in ("grid", "ring"):
            for driven in load_rounds(folder / "work" / step.format(region) / f"clock-{region}.parquet"):
                assert driven.end_s - driven.start_s <= deadline_s + 1e-6
                for timing in driven.clients:
                    outcomes[f"{region}/{timing.client}"].append(timing)
                    lengths[f"{region}/{timing.client}"] += driven.end_s - driven.start_s
    assert {timing.dropped for timing in outcomes["grid/cav3"]} == {"past the deadline"}
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables(result)["rounds"].splitlines()[2:]]
    assert {name: len(own) for name, own in outcomes.items()} == {name: len(own) for name, own in joins.items()}
    for _, name, speed, planned, combined, lost, seconds in rows:
        own = outcomes[name]
        assert float(speed) == {"grid/cav1": 0.5, "grid/cav3": 0.3, "ring/cav0": 0.5}.get(name, 1.0)
        assert (int(planned), int(combined)) == (len(joins[name]), sum(not timing.dropped for timing in own))
        assert sum(int(each.split()[0]) for each in lost.split(", ") if each) == sum(bool(t.dropped) for t in own)
        assert float(seconds) == pytest.approx(lengths[name], abs=0.06)
    assert {"timeline_grid", "timeline_ring"} <= {*draw(result, folder / "work", Seen())}


def test_on_the_radio_megabytes_of_stragglers_return_to_the_plan_which_says_who_uploads(
    radio: tuple[Path, RunRecipe, Run],
) -> None:
    folder, _, result = radio
    main = result.arms[MAIN]
    first = main.plans[0].tasks["weather"]
    assert (first.edge_rounds, first.cloud_rounds) == (2, 1)
    assert main.plan.tasks["weather"].cloud_rounds > 1  # bought by what stragglers did not send
    assert main.links["wireless"].used_mb <= main.links["wireless"].budget_mb
    uploads = first.uploads
    assert uploads is not None
    book = Ledger.load(folder / "ledgers/main.parquet").entries  # clients of stage I: "SCENE/vehicle"
    sent = Counter(e.client for e in book if (e.stage, e.link, e.direction) == (PRETRAIN, "wireless", "up"))
    of_vehicles = Counter({f"suburb/{name.rpartition('/')[2]}": count for name, count in sent.items()})
    assert of_vehicles == Counter(uploads)
    assert sum(uploads.values()) == 3
    assert (folder / SPREAD).exists()  # of the retraining


def test_stage_two_alone_has_the_stragglers_of_the_run(
    radio: tuple[Path, RunRecipe, Run], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, recipe, result = radio
    (folder / "radio.yaml").write_text(recipe.model_dump_json())
    for arm in (MAIN, "timely"):
        with pytest.raises(SystemExit) as ended:
            command(["federate", str(folder / "radio.yaml"), "--out", str(folder), "--arm", arm, "--jobs", "1"])
        assert not ended.value.code
        alone = {each.result.region: each.result for each in Federations.load(folder, name_results(arm)).federations}
        stages = {stage.region: stage for stage in result.arms[arm].stages if stage.stage == EDGE}
        assert [*alone] == [*stages] == ["grid", "ring"]
        for region, stage in stages.items():
            assert alone[region].records == stage.records
            assert all(record.seconds for record in stage.records or ())
    for record in alone["grid"].records or ():  # of the arm that selects by the deadline
        assert "grid/cav3" not in record.clients
        assert record.failed.get("grid/cav3") in (None, TOO_SLOW)
    printed = capsys.readouterr().out
    lost = sum("grid/cav3" in record.failed for record in result.arms[MAIN].stages[0].records or ())
    assert f"grid/cav3 (past the deadline) in {lost}" in printed
    times = TrainTimes.load(folder, TRAIN_TIMES)
    assert {*times.speed} == {"grid", "ring"}
    assert {*times.speed["ring"]} == {
        name.partition("/")[2] for name in times.vehicle_train_s["weather"] if "ring" in name
    }
