"""HTML page of a release: changes, evidence, operational domain, acknowledgements, and hashes."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from flcav.releases.candidate import Acknowledgement, Candidate
from flcav.releases.verification.records import CandidateVerification, Comparison, OddCoverage
from flcav.releases.verification.testing import WORDS
from flcav.report.pages import html

GROUPS = {
    "class": "Classes",
    "distance": "Distance",
    "occlusion": "Occlusion",
    "weather": "Weather",
    "scenario": "Scenarios",
    "town": "Towns",
    "cell": "Cells of the domain",
    "found": "Found at the score of use",
    "condition": "Conditions of the sensor",
    "measure": "Other measures",
    "false": "False boxes a frame, from the score of use on",
    "right": "Share of right boxes, from the score of use on",
    "heading": "Headings of boxes that find an object: 1 right, 0 reversed",
    "score": "Scores minus the share of right boxes, from the score of use on",
    "error": "Mean errors of boxes that find an object [m, rad]",
    "bias": "Mean signed errors [m, rad]",
    "variance": "Variances: logarithm of these errors in predicted standard deviations",
}
WEAK = "not judged"  # guards on which the driving network scores near zero, or with too few scenes
PARTIES = ("provider", "customer")
MEANINGS = {"kept": "kept", "lost": "lost", "open": "not told"}
STATES = {"kept": "held", "lost": "did-not-hold", "open": "undecided"}  # classes of style


def release_page(
    candidate: Candidate,
    verification: CandidateVerification,
    hashes: Mapping[str, str],
    acknowledgements: Sequence[Acknowledgement] = (),
) -> str:
    """Return the page as self-contained HTML.

    `hashes` are the SHA-256 of the candidate's files by name, `acknowledgements` the parties' signatures so far.
    """
    groups = {
        title: [_row(guard) for guard in verification.guards if guard.by == by]
        for by, title in GROUPS.items()
        if any(guard.by == by for guard in verification.guards)
    }
    whole = None if verification.whole is None else _row(verification.whole)
    every = [row for rows in groups.values() for row in rows]
    left = [row for row in every if row["judgement"] == "open" and row["word"] != WEAK]
    values = {
        "candidate": candidate.model_dump(mode="json"),
        "verification": asdict(verification),
        "verdict": "accepted" if verification.accepted else "undecided" if verification.undecided else "refused",
        "whole": whole,
        "scale": _scale(verification),
        "groups": groups,
        "weak": [row for row in every if row["word"] == WEAK],
        "left": sorted(left, key=lambda row: row["spare"]),
        "domain": None if verification.domain is None else _domain(verification),
        "hashes": hashes,
        "acknowledgements": [asdict(signed) for signed in acknowledgements],
        "missing": [party for party in PARTIES if party not in {signed.party for signed in acknowledgements}],
        "complete": bool(acknowledgements) and all(len(signed.keys) >= signed.threshold for signed in acknowledgements),
        "spent": [{**spent.model_dump(), "mb": spent.bytes / 1e6} for spent in candidate.spent],
    }
    return html.render(values, {}, "release.html.j2")


def _row(guard: Comparison) -> dict[str, Any]:
    name = WORDS.get(guard.name, guard.name.replace("_", " ").replace(" x ", " × "))
    change = guard.candidate - guard.driving
    return {
        **asdict(guard),
        "name": name,
        "change": change,
        "word": WEAK if guard.spare is None else MEANINGS[guard.judgement],
        "state": STATES[guard.judgement],
    }


def _scale(verification: CandidateVerification) -> dict[str, float] | None:
    """Return the positions of interval, mean and margin on a bar with 0 in its middle, in percent of its width."""
    whole = verification.whole
    if whole is None:
        return None
    ends = (whole.low, whole.high, -verification.margin, verification.margin)
    reach = 1.25 * max(abs(end) for end in ends)
    place = {
        "low": whole.low,
        "mean": whole.candidate - whole.driving,
        "high": whole.high,
        "margin": -verification.margin,
    }
    return {name: round(50 + 50 * value / reach, 2) for name, value in place.items()}


def _domain(verification: CandidateVerification) -> list[tuple[str, str]]:
    domain = verification.domain
    assert domain is not None
    spans = {
        "visibility": (domain.visibility_m, "m"),
        "rain": (domain.rain_mm_h, "mm/h"),
        "elevation of the sun": (domain.sun_elevation_deg, "degrees"),
        "speed of objects": (domain.speed_m_s, "m/s"),
        "distance of objects": (domain.distance_m, "m"),
    }
    rows = [
        ("towns", ", ".join(domain.towns)),
        ("scenarios", "; ".join(domain.scenarios).replace("_", " ")),
        ("weather", ", ".join(domain.weathers).replace("_", " ")),
        *((name, f"{span[0]:.4g} to {span[1]:.4g} {unit}") for name, (span, unit) in spans.items() if span is not None),
        ("objects", ", ".join(f"{count} {label}" for label, count in domain.objects.items())),
        ("LiDARs", ", ".join(domain.lidars)),
        (f"OpenODD domain {domain.odd.domain}", _judged(domain.odd)),
        (
            "not covered of it",
            "; ".join(f"{name.replace('_', ' ')} {', '.join(buckets)}" for name, buckets in domain.odd.holes.items())
            or "nothing",
        ),
    ]
    return rows


def _judged(odd: OddCoverage) -> str:
    frames = ", ".join(f"{count} {verdict}" for verdict, count in odd.frames.items())
    return f"frames {frames}; {odd.grade:.0%} of the buckets inside it, mean over its attributes"
