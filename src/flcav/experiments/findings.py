"""What the article claims, held against one run: sentences computed from the run's numbers.

A claim is about a difference of AP50. Its interval is a paired bootstrap over scenes (95 %): wholly above 0 the claim
held, wholly below it did not, around 0 the run does not decide.
"""

from collections.abc import Mapping
from typing import Any

from flcav.verdicts import UNDECIDED, signed, verdict, verdict_words

CAVEAT = "ideal road detector, upper bound"


def findings(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the three findings about `results`: name, question, verdict and a sentence with the numbers behind it."""
    pretrained, edge, cloud = (stage["ap50"] for stage in results["stages"])
    town = results["stages"][0]["town"]
    differences = results["differences"]
    return [
        _finding(
            "edge",
            "Does federated learning beat pretraining alone?",
            f"On {town}, edge FL moved AP50 from {pretrained:.3f} to {edge:.3f}",
            differences["edge_minus_pretrained"],
            results,
        ),
        _finding(
            "cloud",
            "Does cloud FL add to edge FL?",
            f"On {town}, cloud FL moved AP50 from {edge:.3f} to {cloud:.3f}",
            differences["cloud_minus_edge"],
            results,
        ),
        _pole_finding(results),
    ]


def _pole_finding(results: Mapping[str, Any]) -> dict[str, str]:
    question = "Does the placed pole beat the pole with the densest traffic?"
    place = results["placement"]
    chosen, densest = place["chosen"], place["densest"]
    if chosen == densest:
        sentence = (
            f"Pole {chosen}, placed by VRCSP, is also the pole where traffic is densest: there is nothing to compare, "
            f"so this run does not decide."
        )
        return {"name": "pole", "question": question, "verdict": UNDECIDED, "sentence": sentence}
    measured = (
        f"Edge FL reached AP50 {place['ap50_chosen']:.3f} with pole {chosen}, placed by VRCSP, and "
        f"{place['ap50_densest']:.3f} with pole {densest}, where traffic is densest"
    )
    return _finding("pole", question, measured, place["difference"], results)


def _finding(
    name: str, question: str, measured: str, difference: Mapping[str, float], results: Mapping[str, Any]
) -> dict[str, str]:
    mean, low, high = difference["mean"], difference["low"], difference["high"]
    decided = verdict(low, high)
    sentence = (
        f"{measured}: {signed(mean)}, 95 % interval {signed(low)} to {signed(high)} over {results['test_frames']} "
        f"test frames of {results['test_scenes']} scenes; {verdict_words(decided)} ({CAVEAT})."
    )
    return {"name": name, "question": question, "verdict": decided, "sentence": sentence}
