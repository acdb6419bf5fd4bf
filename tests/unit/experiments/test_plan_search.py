"""The search for settings in which the joint plan is worth a training."""

import numpy as np
import pytest

from flcav.optimization.curves.fitting import fit
from flcav.reproductions.plan_search import run as search
from flcav.runs.tables import load_known_history


@pytest.fixture(scope="module")
def found() -> list[search.Found]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "WIRELESS_MB", (40.0, 80.0))
        patch.setattr(search, "WIRELINE_MB", (40.0,))
        patch.setattr(search, "FLEETS", ((4, 3),))
        patch.setattr(search, "FORMS", {"whole": 1.0})
        return [*search.search_plans(search.PROBLEMS[0])]


def test_a_joint_plan_is_never_predicted_to_be_worse(found: list[search.Found]) -> None:
    assert len(found) == 2
    assert all(row.difference > 0 for row in found)


def test_plans_keep_both_budgets_and_have_the_accuracy_of_the_curve(found: list[search.Found]) -> None:
    curve = fit(load_known_history("objects"), model="best").curve
    sample, update = search.SIZES_MB["objects"]
    for row in found:
        for plan, predicted in zip((row.joint, row.rival), row.predicted, strict=True):
            ((samples, edge, cloud),) = plan
            assert samples * sample + (edge + cloud) * sum(row.fleet) * update <= row.wireless_mb
            assert samples * sample + cloud * len(row.fleet) * update <= row.wireline_mb
            assert predicted == pytest.approx(1 - float(curve.error(samples, edge, cloud, 1)), abs=1e-9)


def test_counts_are_those_of_the_settings(found: list[search.Found]) -> None:
    results = search.summarise({"one": found})
    gains = [row.difference for row in found]
    assert results.settings == {"one": 2}
    assert results.worth == {"one": sum(gain >= search.WORTH for gain in gains)}
    assert results.best[0].difference == max(gains)
    assert np.array(results.maps["one"])[:, 2].tolist() == gains
