"""The search of a network: its steps, its summary, the front, the table and the picture."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from flcav.reproductions.networks import run as networks
from flcav.reproductions.networks.run import (
    CHOSEN,
    NETWORKS,
    REFERENCE,
    TOWNS,
    NetworkCost,
    NetworksResult,
    TrainedNetwork,
    draw_networks,
    find_front,
    list_steps,
    networks_tables,
    search_networks,
)
from flcav.runs.recipe import load_run_recipe
from flcav.sources.recipe import recipe_path
from flcav.statistics.seeds import mean_over_seeds


def cost(seconds: float, ap: float) -> NetworkCost:
    mean = {town: mean_over_seeds([ap], share=True) for town in TOWNS}
    return NetworkCost(1, seconds, seconds, mean, mean)


@pytest.mark.parametrize("seed", range(5))
def test_the_front_is_what_no_other_beats(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = {str(number): (rng.integers(1, 6), rng.integers(1, 6) / 8) for number in range(7)}
    front = set(find_front({name: cost(float(s), float(a)) for name, (s, a) in points.items()}))
    for (one, (s, a)), (two, (t, b)) in combinations(points.items(), 2):
        if (s, a) != (t, b):
            assert not (s <= t and a >= b and two in front)
            assert not (t <= s and b >= a and one in front)
    assert any(points[name][1] == max(a for _, a in points.values()) for name in front)


def test_it_pretrains_as_the_demo_does() -> None:
    recipe = load_run_recipe(recipe_path("runs/demo"))
    assert recipe.tasks["objects"].network == CHOSEN
    assert recipe.training_of("objects").steps == networks.STEPS
    assert recipe.with_role("pretrain") == (networks.TRAINED,)
    assert not set(TOWNS) - {networks.TRAINED} & set(recipe.regions), "what is chosen is not proven on the same towns"


def test_seeds_train_every_candidate_and_shares_are_of_the_same_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = {(name, seed): 10.0 * (1 + place) * seed for place, name in enumerate(NETWORKS) for seed in (1, 2)}

    def run_steps(steps, out, **how):
        found = {}
        for step in steps:
            if "seed" in step.arguments:
                name, seed = step.arguments["name"], step.arguments["seed"]
                ap = dict.fromkeys(TOWNS, 0.5 + 0.01 * seed)
                found[step.name] = {"seconds": seconds[name, seed], "ap50": ap, "ap70": ap}
        return found

    monkeypatch.setattr(networks, "run_steps", run_steps)
    half: dict[str, float] = {str(town): 0.52 for town in TOWNS}
    results = search_networks(
        tmp_path, seeds=(1, 2), quick=False, jobs=1, notify=lambda *about: None, stale="refuse", engine="processes"
    )
    assert [own.share for own in results.networks.values()] == pytest.approx(range(1, 1 + len(NETWORKS)))
    assert results.networks[CHOSEN].ap50["suburb"].mean == pytest.approx(0.515)
    assert results.front == (REFERENCE,)  # all are as accurate here, and it is the fastest
    assert results.seeds["2"][CHOSEN] == TrainedNetwork(seconds[CHOSEN, 2], half, half)
    assert NetworksResult.from_json(results.as_json(), "results") == results
    table = networks_tables(results)["networks"]
    assert all(name in table for name in NETWORKS)
    assert draw_networks(results).startswith(b"\x89PNG")
    assert len(results.sentences()) == 1 + len(NETWORKS)


@pytest.mark.slow
def test_every_candidate_is_trained_and_scored(tmp_path: Path) -> None:
    """The step itself, on four sweeps and two optimiser steps."""
    from flcav.runs.engine import run_steps

    steps = list_steps((1,), quick=True)
    kept = [step for step in steps if step.arguments.get("name") in (None, CHOSEN)]
    values = run_steps(kept, tmp_path, jobs=1, notify=lambda *about: None)
    found = values["pillars-seed1"]
    assert found["seconds"] > 0
    assert set(found["ap50"]) == set(found["ap70"]) == set(TOWNS)
