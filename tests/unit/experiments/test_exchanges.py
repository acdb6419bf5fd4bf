"""The comparison of exchanges: whose accuracy counts where, seconds of rounds, means, verdicts, tables, the figure."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flcav.experiments.experiment import shrink_recipe
from flcav.federation.state import Divergence, RoundDivergence
from flcav.federation.upload import name_like
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.network.radio.budget import PathState, Radio
from flcav.network.radio.links import RadioLinks
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.reproductions.federation.exchange import run as exchanges
from flcav.reproductions.federation.exchange.run import (
    NAMES,
    NO_CLOUD,
    NONE,
    OTHERS,
    OWN,
    UNSEEN,
    WHOLE,
    ExchangeArm,
    draw_results,
    judge_differences,
    mean_round_s,
    measure_places,
    measure_seed,
    summarise,
    tables,
)
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, Federation, load_run_recipe
from flcav.sources.recipe import recipe_path
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED

RECIPE = load_run_recipe(recipe_path("runs/exchange"))


def test_every_arm_of_the_recipe_is_compared_and_can_be_federated() -> None:
    assert set(NAMES.values()) == {PRETRAIN, EDGE, MAIN, *RECIPE.arms}
    check_federations(RECIPE, resolve_settings(RECIPE, {"weather": "annotated"}).values())


def test_arms_of_objects_have_the_names_of_those_of_the_weather() -> None:
    recipe = load_run_recipe(recipe_path("runs/exchange_objects"))
    assert {*recipe.arms} <= {*NAMES.values()}
    check_federations(recipe, resolve_settings(recipe, {"objects": "road"}).values())
    norms = Federation.model_validate(recipe.arms["norms"].federation)
    network = build_network(OBJECTS, find_configuration(OBJECTS, "tiny"), 0)
    kept = name_like(to_arrays(network), norms.personal_arrays)
    normalised = {name.rpartition(".")[0] for name in to_arrays(network) if name.endswith("running_mean")}
    assert kept == [name for name in to_arrays(network) if name.rpartition(".")[0] in normalised]


def test_without_an_unseen_region_it_has_no_column() -> None:
    names = (NONE, NO_CLOUD, WHOLE, "int8", "output layer (FedPer)")
    seeds = {}
    for number in (1, 2):
        own = replace(arm(0.5, 9.0), accuracy={OWN: 0.5 + 0.01 * number, OTHERS: 0.4})
        seeds[str(number)] = dict.fromkeys(names, own) | {NONE: replace(own, wireless_up_mb=0.0)}
    results = summarise(load_run_recipe(recipe_path("runs/exchange_objects")), seeds)
    shown = tables(results)
    assert shown["accuracy"].splitlines()[0] == "| | arm, 2 seeds | AP50, own region | AP50, other regions |"
    assert "compared with | no federation" in shown["accuracy"].splitlines()[2]
    assert shown["cloud"] == ""  # not measured
    assert len(shown["accuracy"].splitlines()) == 2 + len(names)
    assert "unseen" not in shown["differences"]
    assert len(shown["differences"].splitlines()) == 2 + len(names) - 1
    assert draw_results(results).startswith(b"\x89PNG")


def test_the_quick_recipe_uploads_no_more_than_its_pools_hold() -> None:
    quick = shrink_recipe(RECIPE)
    pool, plan = quick.sized_splits.pool, quick.tasks["weather"].plan
    assert plan is not None
    assert plan.samples <= pool.scenes * pool.spins * pool.cavs


def test_a_region_has_its_own_model_where_it_keeps_one() -> None:
    of_all = {"suburb": 0.5, "grid": 0.6, "ring": 0.7, "arterial": 0.4}
    kept = {("grid", "grid"): 0.8, ("ring", "ring"): 0.9, ("grid", "ring"): 0.3, ("ring", "grid"): 0.1}
    kept |= {("grid", "suburb"): 0.2, ("ring", "suburb"): 0.4, ("grid", "arterial"): 0.0, ("ring", "arterial"): 0.0}

    def mean(value: float) -> Any:
        return SimpleNamespace(estimate=SimpleNamespace(mean=value))

    regional = [SimpleNamespace(model=m, region=r, **vars(mean(value))) for (m, r), value in kept.items()]
    run = SimpleNamespace(
        recipe=RECIPE,
        arms={MAIN: SimpleNamespace(regional=None), "heads": SimpleNamespace(regional=regional)},
        test=lambda *, arm, stage, region, task: mean(of_all[region]),
    )
    whole = measure_places(cast(Any, run), MAIN, CLOUD)
    assert whole == pytest.approx({OWN: 0.65, OTHERS: (0.5 + 0.7 + 0.5 + 0.6) / 4, UNSEEN: 0.4})
    heads = measure_places(cast(Any, run), "heads", CLOUD)
    assert heads == pytest.approx({OWN: 0.85, OTHERS: (0.2 + 0.3 + 0.4 + 0.1) / 4, UNSEEN: 0.4})
    assert measure_places(cast(Any, run), "heads", PRETRAIN) == pytest.approx(whole)
    assert measure_places(cast(Any, run), MAIN, EDGE) == pytest.approx({OWN: 0.65})


def links_of(*present: bool) -> RadioLinks:
    """Return two vehicles' links to one unit, near enough for the highest rate, that do not change for 100 s."""
    state = np.where(present, PathState.LOS, -1).astype(np.int8)[None, :, None].repeat(101, axis=0)
    distance, loss = np.where(state < 0, np.nan, 50.0), np.where(state < 0, np.inf, 69.0)
    return RadioLinks(Radio(), np.arange(0.0, 101.0), ("cav0", "cav1"), ("pole1",), distance, state, loss)


def entry(client: str, direction: Any, size: int, stage: str = "edge", round_: int = 1) -> LedgerEntry:
    return LedgerEntry(stage, "weather", "wireless", direction, round_, client, size)


def test_a_round_lasts_until_the_last_update_has_arrived() -> None:
    near = links_of(True, True)  # 2 bit/s/Hz in 10 MHz: 20 Mbit/s for one, 10 for each of two
    both = [entry(f"grid/cav{i}", way, 1_250_000) for i in (0, 1) for way in ("down", "up")]
    assert mean_round_s(both, {"grid": [near]}, 6) == pytest.approx(4 * 1_250_000 * 8 / 20e6)
    alone = [each for each in both if each.client == "grid/cav0"]
    assert mean_round_s(alone, {"grid": [near]}, 6) == pytest.approx(2 * 1_250_000 * 8 / 20e6)
    before = entry("grid/cav0", "down", 9_000_000, round_=0)  # the pretrained network, before the first round
    wired = LedgerEntry("edge", "weather", "wireline", "up", 1, "grid", 9_000_000)
    assert mean_round_s([before, wired, *alone], {"grid": [near]}, 6) == pytest.approx(1.0)


def test_scenes_go_on_in_stage_three_and_who_is_away_does_not_count() -> None:
    scenes = [links_of(True, True), links_of(False, True)]
    sent = [entry("grid/cav0", "up", 1_250_000, "cloud"), entry("grid/cav1", "up", 2_500_000, "cloud")]
    assert mean_round_s(sent, {"grid": scenes}, 2) == pytest.approx(1.5)  # in the third scene, the first again
    assert mean_round_s(sent, {"grid": scenes}, 1) == pytest.approx(1.0)  # in the second, with cav1 alone
    assert mean_round_s(sent[:1], {"grid": scenes}, 1) is None


def test_edge_federation_alone_has_the_accuracy_the_messages_and_the_rounds_of_stage_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exchanges, "link_regions", lambda *_: {"grid": [links_of(True, True)]})
    sent = [entry("grid/cav0", "up", 2_000_000), entry("grid/cav0", "up", 1_000_000, CLOUD)]
    sent.append(LedgerEntry(PRETRAIN, "weather", "wireless", "up", 0, "suburb", 9_000_000))
    Ledger(LinkMegabytes(60, 30), sent).save(tmp_path / "ledgers" / "main.parquet")
    clients = {EDGE: ("cav0", "cav1"), CLOUD: ("cav0",)}
    stages = [
        SimpleNamespace(stage=stage, records=[SimpleNamespace(server="grid", clients=names, epsilon=None)])
        for stage, names in clients.items()
    ]
    plan = SimpleNamespace(tasks={"weather": SimpleNamespace(edge_rounds=1, cloud_rounds=1)})
    reached = {PRETRAIN: 0.5, EDGE: 0.6, CLOUD: 0.7}
    run = SimpleNamespace(
        recipe=RECIPE,
        arms={MAIN: SimpleNamespace(regional=None, stages=stages, plan=plan)},
        test=lambda *, arm, stage, region, task: SimpleNamespace(estimate=SimpleNamespace(mean=reached[stage])),
    )
    found = measure_seed(cast(Any, run), tmp_path)
    assert {*found} == {NONE, NO_CLOUD, WHOLE}
    alone, whole = found[NO_CLOUD], found[WHOLE]
    assert alone.accuracy == {OWN: 0.6}
    assert whole.accuracy == pytest.approx({OWN: 0.7, OTHERS: 0.7, UNSEEN: 0.7})
    assert (alone.wireless_up_mb, whole.wireless_up_mb) == (2.0, 3.0)
    assert (alone.clients, whole.clients) == (2.0, 1.5)


def arm(own: float, up_mb: float, epsilon: float | None = None) -> ExchangeArm:
    return ExchangeArm(
        {OWN: own, OTHERS: own - 0.1, UNSEEN: own - 0.2}, up_mb, 14.0, 1.0, 1.0, 3.5, 0.4 if up_mb else None, epsilon
    )


def results_of(seeds: int) -> Any:
    found = {}
    for number in range(1, seeds + 1):
        shift = 0.01 * number
        arms = {name: arm(0.75 + shift + 0.001 * (number % 2), 14.0) for name in NAMES}
        arms |= {NONE: arm(0.6 + shift + 0.002 * (number % 3), 0.0), WHOLE: arm(0.75 + shift, 14.0)}
        arms |= {"models (Ditto)": arm(0.85 + shift + 0.002 * (number % 2), 14.0)}
        arms |= {NO_CLOUD: replace(arm(0.7 + shift, 9.0), accuracy={OWN: 0.75 + shift - 0.01 * number})}
        found[str(number)] = arms | {"local noise, 1": arm(0.15 + 0.02 * (number % 2), 14.0, 43.2)}
    return summarise(RECIPE, found)


def test_what_cloud_rounds_gain_stands_beside_how_far_the_regions_are_apart() -> None:
    results = results_of(4)
    assert [*results.accuracy[NO_CLOUD]] == [*results.differences[NO_CLOUD]] == [OWN]
    assert "| what the cloud does | no cloud round | 0.75" in tables(results)["accuracy"]
    apart = {
        str(seed): RoundDivergence(Divergence(0.1 * seed, 0.3, 0.01), Divergence(0.5 - 0.1 * seed, 0.4, 0.02))
        for seed in range(1, 5)
    }
    shown = tables(replace(results, divergence=apart))["cloud"].splitlines()
    assert "| own region: cloud - edge FL |" in shown[0]
    assert shown[2].startswith("| seed 1 | 0.1000 | 0.0100 | 0.3000 | 0.4000 |")
    assert shown[2].endswith("| +0.010 |")
    assert shown[6].endswith("| +0.025 |")
    assert "| +1.00 (p 0.08) |" in shown[7]
    assert "| -1.00 (p 0.08) |" in shown[7]


def test_differences_are_paired_and_judged_together() -> None:
    results = results_of(5)
    assert results.differences[NONE][OWN].mean == pytest.approx(-0.15 + 0.002 * (1 + 2 + 0 + 1 + 2) / 5)
    judged = judge_differences(results)
    assert WHOLE not in judged
    assert judged[NONE].verdict == NOT_HELD
    assert judged["models (Ditto)"].verdict == HELD
    assert judged["int8"].verdict == UNDECIDED
    assert {each.family for each in judged.values()} == {len(NAMES) - 1}
    assert results.accuracy[WHOLE][UNSEEN].mean == pytest.approx(0.58)


def test_tables_say_bytes_epsilon_and_how_many_seeds_an_undecided_difference_takes() -> None:
    shown = tables(results_of(5))
    assert "| local noise, 1 | 14.000 | 14.00 | 1.000 | 1.00 | 3.5 | 0.40 | 43.2 |" in shown["costs"]
    assert "| int8 | 14.000 | 14.00 | 1.000 | 1.00 | 3.5 | 0.40 | ∞ |" in shown["costs"]
    assert NONE not in shown["costs"]
    rows = {row.split(" | ")[0].strip("| "): row.split(" | ") for row in shown["differences"].splitlines()}
    assert [*rows][2:] == [name for name in NAMES if name != WHOLE]
    assert rows["models (Ditto)"][3] == "higher"
    assert rows[NONE][3] == "lower"
    assert rows["int8"][3] == "undecided"
    assert int(rows["int8"][4]) > 5


def test_the_figure_is_the_same_of_the_same_numbers_and_takes_one_seed() -> None:
    assert draw_results(results_of(1)).startswith(b"\x89PNG")
