"""What arms cost and gain, against the committed results of the demo, read as plain JSON."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Annotation

from flcav.report import style
from flcav.report.charts import figures
from flcav.report.pages import html
from flcav.report.pages.run_page import page
from flcav.runs.analysis.costs import list_arm_costs
from flcav.runs.results.run import Run
from flcav.statistics.estimates import Estimate
from flcav.statistics.verdicts import signed

DEMO = Path(__file__).parents[3] / "reproductions" / "runs" / "demo" / "earlier" / "road"


@pytest.fixture(scope="module")
def run() -> Run:
    return Run.load(DEMO, "results.json")


def test_costs_are_those_of_ledgers_and_tests(run: Run):
    raw = json.loads((DEMO / "results.json").read_text())
    rows = {row.arm: row for row in list_arm_costs(run)}
    assert [*rows] == [*raw["arms"]] == ["main", "densest", "ideal"]
    for name, row in rows.items():
        regions = ["grid", "ring"] if name == "main" else ["grid"]
        last = "cloud" if name == "main" else "edge"
        after = [
            each["estimate"]
            for each in raw["tested"]
            if each["arm"] == name and each["stage"] == last and each["region"] in regions
        ]
        before = [
            each["estimate"]["mean"]
            for each in raw["tested"]
            if each["stage"] == "pretrain" and each["region"] in regions
        ]
        sent = {"wireless": 0.0, "wireline": 0.0}
        for each in raw["arms"][name]["spent"]:
            sent[each["link"]] += each["mb"] * (each["stage"] != "pretrain")
        gain = np.mean([each["mean"] for each in after]) - np.mean(before)
        assert (row.regions, row.stage, row.epsilon) == (tuple(regions), last, None)
        assert (row.wireless_mb, row.wireline_mb) == pytest.approx((sent["wireless"], sent["wireline"]))
        assert row.gain == pytest.approx(gain)
        assert row.gain_per_mb == pytest.approx(gain / (sent["wireless"] + sent["wireline"]))
        assert row.after.low is not None
        half = np.sqrt(np.sum([(each["mean"] - each["low"]) ** 2 for each in after])) / len(after)
        assert row.after.low == pytest.approx(row.after.mean - half)
    assert (rows["main"].edge_rounds, rows["main"].cloud_rounds, rows["ideal"].cloud_rounds) == (5, 1, 0)


def test_the_report_has_a_table_of_arms_and_one_of_all_claims(run: Run):
    shown = html.render(page(run), {}, drawings={"gain": "<svg></svg>"})
    assert "Arms and megabytes" in shown
    assert f"<td>{signed(list_arm_costs(run)[0].gain)}</td>" in shown
    table = shown[shown.index('<table class="claims">') :]
    table = table[: table.index("</table>")]
    assert table.count("<tr><td>") == len(run.findings)
    assert table.count('<span class="forest"') == len(run.findings)
    assert table.count('class="badge undecided"') == sum(each.verdict == "undecided" for each in run.findings) > 3


def test_names_of_arms_keep_apart(run: Run):
    one = list_arm_costs(run)[0]
    drawn = (("main", 30.0, 0.6), ("other", 30.0, 0.6), ("third", 12.0, 0.6), ("bare", 30.2, 0.61))
    rows = [
        replace(one, arm=name, wireless_mb=mb - 10, wireline_mb=10.0, after=Estimate(score, score - 0.1, score + 0.1))
        for name, mb, score in drawn
    ]
    figure = figures.gains(rows)
    assert style.png(figure)[:4] == b"\x89PNG"
    names = {text.get_text(): text.xyann for text in figure.axes[0].texts if isinstance(text, Annotation)}
    assert names.keys() == {"main", "other", "third", "bare"}
    heights = sorted(names[name][1] for name in ("main", "other", "bare"))
    low, high = figure.axes[0].get_ylim()
    assert min(np.diff(heights)) > 0.06 * (high - low)
