"""Verification of candidates on made-up frames: what is equal passes, what is lost is refused by name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from release_drives import Drives
from release_parties import Parties
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.geometry import Boxes
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.perception.metrics import average_precision, match
from flcav.perception.objects.evaluate import split_parts
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth
from flcav.perception.weights import load_network
from flcav.releases.candidate import CARD, LEDGER, WEIGHTS, DataHash, LedgerSum, read_candidate
from flcav.releases.verification import verify
from flcav.releases.verification.comparison import (
    GuardPair,
    Limit,
    compare_pair,
    draw_scenes,
    measure_results,
    pair_slices,
)
from flcav.releases.verification.files import find_faults, find_overlap
from flcav.releases.verification.records import CandidateVerification, OddCoverage, VerificationData, VerifiedDomain
from flcav.releases.verification.testing import CONDITIONS, LIFTED_M, PLAIN, ConditionResults, VerificationFrame
from flcav.releases.verification.verify import (
    decide_on_candidate,
    describe_domain,
    read_verification,
    write_verification,
)
from flcav.report.pages.release_page import release_page
from flcav.sensors.frame import Annotations, Frame
from flcav.statistics.power import plan_scenes
from flcav.storage.files import sha256

SCENES, FRAMES = 24, 1
SIZE = {"Car": (4.4, 1.8, 1.6), "Pedestrian": (0.8, 0.6, 1.7)}
Change = Callable[[Boxes, FrameTruth], Boxes]
Results = dict[str, ConditionResults]


@pytest.fixture(autouse=True)
def few_redraws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Decide by fewer bootstrap samples than a release does."""
    monkeypatch.setattr(verify, "GUARD_REDRAWS", 60)


def truth_of(scene: int, rng: np.random.Generator) -> FrameTruth:
    """Four cars and two pedestrians, ten metres apart from each other."""
    labels = ["Car"] * 4 + ["Pedestrian"] * 2
    center = np.stack((6 + 6 * np.arange(6) + rng.uniform(-1, 1, 6), rng.uniform(-8, 8, 6), np.full(6, -1.0)), axis=1)
    size = np.array([SIZE[label] for label in labels])
    boxes = Boxes(center, size, rng.uniform(-3, 3, 6), np.array(labels))
    none = Boxes.empty()
    return FrameTruth(f"s{scene}", boxes, none, none, np.full(6, 0.1), "fog" if scene % 3 == 0 else "clear")


def detect(truth: FrameTruth, rng: np.random.Generator, found: float = 0.85) -> Boxes:
    """A detector that finds a share of the targets, and invents some."""
    kept = truth.targets[np.flatnonzero(rng.random(6) < found)]
    invented = replace(truth.targets[[0, 4]], center=truth.targets.center[[0, 4]] + (0, 20, 0))
    every = [kept, invented[np.flatnonzero(rng.random(2) < 0.3)]]
    center = np.concatenate([each.center for each in every])
    score = np.concatenate([rng.uniform(0.4, 1, len(every[0])), rng.uniform(0.1, 0.6, len(every[1]))])
    parts = [np.concatenate([getattr(each, name) for each in every]) for name in ("size", "yaw", "label")]
    return Boxes(center, *parts, score=score)


def run(
    seed: int, change: Change | None = None, found: float = 0.85, scenes: int = SCENES
) -> dict[str, ConditionResults]:
    """Results of a detector that draws its misses from `seed` on frames that are always the same."""
    results = {}
    for name in (PLAIN, *CONDITIONS):
        world, own = np.random.default_rng(0), np.random.default_rng((seed, len(name)))
        truths = [truth_of(scene, world) for scene in range(scenes) for _ in range(FRAMES)]
        boxes = [detect(truth, own, found) for truth in truths]
        if change is not None:
            boxes = [change(one, truth) for one, truth in zip(boxes, truths, strict=True)]
        frames = tuple(
            VerificationFrame(Path("d"), number, "grid", "everyday traffic", ("none", "crossroad")[number % 2])
            for number in range(len(truths))
        )
        results[name] = ConditionResults(frames, tuple(boxes), tuple(truths))
    return results


def judge(new: Results, scenes: int = SCENES, margin: float = 0.03) -> CandidateVerification:
    candidate = read_candidate_like()
    data = [VerificationData("d", "a" * 64, "grid", 1, scenes * FRAMES, scenes)]
    return decide_on_candidate(candidate, run(1, scenes=scenes), new, data, None, margin)


def read_candidate_like():
    from flcav.releases.candidate import Candidate

    fields = dict.fromkeys(("weights", "driving", "card"), "b" * 64)
    return Candidate(task="objects", release=2, changes="", audience="", network="pillars", data=(), **fields)


def without(label: str) -> Change:
    return lambda boxes, _: boxes[np.flatnonzero(boxes.label != label)]


def near_only(boxes: Boxes, _: FrameTruth) -> Boxes:
    return boxes[np.flatnonzero(boxes.center[:, 0] < 20)]


def blind_in_fog(boxes: Boxes, truth: FrameTruth) -> Boxes:
    return boxes[:0] if truth.weather == "fog" else boxes


def lifted(boxes: Boxes, _: FrameTruth) -> Boxes:
    return replace(boxes, center=boxes.center + np.array([0, 0, 0.4]))


def turned(boxes: Boxes, _: FrameTruth) -> Boxes:
    return replace(boxes, yaw=boxes.yaw + np.pi)


def hushed_far(boxes: Boxes, _: FrameTruth) -> Boxes:
    return replace(boxes, score=np.asarray(boxes.score) * np.where(boxes.center[:, 0] > 20, 0.3, 1.0))


def hushed(boxes: Boxes, _: FrameTruth) -> Boxes:
    return replace(boxes, score=np.asarray(boxes.score) * 0.3)


def test_the_driving_network_itself_is_accepted():
    found = judge(run(1))
    assert found.accepted
    assert found.whole is not None
    assert found.whole.candidate == found.whole.driving
    assert {each.by for each in found.guards} == {
        "class",
        "distance",
        "occlusion",
        "weather",
        "cell",
        "found",
        "measure",
        "condition",
        "false",
        "right",
        "heading",
        "score",
        "error",
        "bias",
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (without("Pedestrian"), "class Pedestrian lost"),
        (near_only, "distance 20-40 m lost"),
        (blind_in_fog, "weather fog lost"),
        (lifted, "measure AP70: accurate boxes lost"),
        (turned, "measure AOS: right headings lost"),
        (hushed_far, "found 20-40 m lost"),
        (hushed, "measure found from score 0.3 on lost"),
    ],
)
def test_what_is_lost_refuses_by_name(change: Change, lost: str):
    found = judge(run(1, change))
    assert not found.accepted
    assert not found.undecided
    assert any(reason.startswith(lost) for reason in found.reasons)
    assert found.whole is not None
    if change in (turned, hushed):  # which average precision does not show
        assert found.whole.candidate == pytest.approx(found.whole.driving, abs=0.02)


def test_slices_are_matched_as_the_evaluation_of_objects_matches_them():
    tested, other = run(1, found=0.7)[PLAIN], run(1)[PLAIN]
    known = {
        (part.by, part.name): part
        for part in split_parts(tested.detections, tested.truths)
        if part.by in ("distance", "occlusion")
    }
    pairs = {(pair.by, pair.name): pair for pair in pair_slices(measure_results(other), measure_results(tested))}
    once = np.ones((1, len(tested.truths)), np.int64)
    for key, part in known.items():
        each = []
        for label in ("Car", "Pedestrian"):
            wanted = [
                truth.targets[inside & (truth.targets.label == label)]
                for truth, inside in zip(tested.truths, part.wanted, strict=True)
            ]
            others = [
                truth.targets[~inside & (truth.targets.label == label)]
                for truth, inside in zip(tested.truths, part.wanted, strict=True)
            ]
            found = [boxes[boxes.label == label] for boxes in part.detections]
            if sum(map(len, wanted)):
                each.append(average_precision(match(found, wanted, others, 0.5)))
        if each:
            assert pairs[key].candidate(once)[0] == pytest.approx(np.mean(each), abs=1e-12), key


def test_a_class_that_is_never_found_any_more_refuses_however_weak_it_was():
    def rare(boxes: Boxes, _: FrameTruth) -> Boxes:
        """Pedestrians are found, but nowhere near one."""
        away = np.where((boxes.label == "Pedestrian")[:, None], [0, 300, 0], 0)
        return replace(boxes, center=boxes.center + away)

    data = [VerificationData("d", "a" * 64, "grid", 1, SCENES * FRAMES, SCENES)]
    driving = run(1, rare)
    assert decide_on_candidate(read_candidate_like(), driving, driving, data, None).accepted
    silent = decide_on_candidate(read_candidate_like(), driving, run(1, without("Pedestrian")), data, None)
    assert [each.partition(":")[0] for each in silent.reasons] == ["class Pedestrian is never found"]


def test_the_page_says_what_was_not_tested_and_not_judged():
    found = judge(run(1))
    weak = replace(found.guards[0], name="Cyclist", driving=0.01, candidate=0.0, spare=None, judgement="open")
    domain = replace(
        describe(run(1)[PLAIN]),
        odd=OddCoverage("mine", None, ("a", "b"), {"inside": 3}, 0.5, {"gradient": ("[8, 12)",)}),
    )
    text = release_page(read_candidate_like(), replace(found, guards=(*found.guards, weak), domain=domain), {})
    assert "hardly finds them itself, or too few scenes have them: Cyclist (0.010, now 0.000)" in text
    assert "gradient [8, 12)" in text
    told = "tested in grid | everyday traffic | clear | mine: frames 3 inside; 50% of its buckets, not gradient [8, 12)"
    assert told in replace(found, domain=domain).lines()
    assert "frames 3 inside" in text
    assert all(f"<b>{party}</b>: not yet" in text for party in ("provider", "customer"))


def pair_of(driving: list[float], candidate: list[float], limit: Limit) -> GuardPair:
    """A pair whose measures are means of numbers of scenes."""

    def mean(values: list[float]):
        return lambda times: times @ np.array(values) / times.sum(axis=1)

    return GuardPair("class", "x", mean(driving), mean(candidate), np.array([*"abcdef"]), 6, 50, limit)


@pytest.mark.parametrize(
    ("driving", "candidate", "limit", "judgement"),
    [
        ([0.5] * 6, [0.3] * 6, Limit(0.8), "lost"),
        ([0.5] * 6, [0.45] * 6, Limit(0.8), "kept"),
        ([0.9, 0.2, 0.1] * 2, [0.1, 0.2, 0.1] * 2, Limit(0.8), "open"),  # falls in two scenes of six
        ([0.04] * 6, [0.0] * 6, Limit(0.8), "open"),  # of which the driving network hardly finds any
        ([0.04] * 6, [0.3] * 6, Limit(2, 0.1, falling=True), "lost"),
        ([0.04] * 6, [0.15] * 6, Limit(2, 0.1, falling=True), "kept"),
        ([0.0] * 6, [2.0, *[0.0] * 5], Limit(2, 0.1, falling=True), "open"),  # all of one scene
        ([0.1] * 6, [-0.3] * 6, Limit(1, -0.2), "lost"),
        ([0.1] * 6, [0.0] * 6, Limit(1, -0.2), "kept"),
    ],
)
def test_a_guard_is_lost_where_its_bound_is_beyond_the_limit(
    driving: list[float], candidate: list[float], limit: Limit, judgement: str
):
    pair = pair_of(driving, candidate, limit)
    found, _ = compare_pair(pair, draw_scenes(pair.scene, 200), 100)
    assert found.judgement == judgement
    assert (found.spare is not None and found.spare < 0) == (judgement == "lost")


def test_a_guard_is_lost_by_chance_in_as_few_families_as_its_level_says():
    rng, lost = np.random.default_rng(0), 0
    for _ in range(200):
        old = rng.normal(0.5, 0.1, 20)
        pairs = []
        for _ in range(20):
            new = 0.8 * old + rng.normal(0, 0.05, 20)  # just at the limit, but for its scenes
            pairs.append((old, new))
        times = rng.multinomial(20, np.full(20, 0.05), size=100)
        every = [
            GuardPair("x", "x", lambda t, v=a: t @ v / 20, lambda t, v=b: t @ v / 20, np.arange(20).astype(str), 20, 50)
            for a, b in pairs
        ]
        lost += any(compare_pair(pair, times, len(every))[0].judgement == "lost" for pair in every)
    assert lost / 200 < 0.1


def test_few_scenes_decide_nothing_and_say_how_many_would():
    whole = judge(run(3, scenes=4), scenes=4).whole
    assert whole is not None
    margin = (whole.driving - whole.candidate - whole.low) / 2  # between the difference and its lower bound
    found = judge(run(3, scenes=4), scenes=4, margin=margin)
    assert not found.accepted
    assert found.undecided
    assert found.frames_to_decide is not None
    assert found.frames_to_decide > 4 * FRAMES
    assert "frames would decide" in found.lines()[-1]


def test_a_single_scene_accepts_nothing():
    found = judge(run(1, scenes=1), scenes=1)
    assert found.undecided
    assert "1 scene, and 10 are wanted" in found.reasons
    assert found.frames_to_decide == 10


def test_a_driving_network_that_finds_nothing_is_no_measure():
    data = [VerificationData("d", "a" * 64, "grid", 1, SCENES * FRAMES, SCENES)]
    nothing = run(1, found=0.0)
    found = decide_on_candidate(read_candidate_like(), nothing, run(2), data, None)
    assert found.reasons == ("AP50 0.000 of the network that drives: nothing that could be kept",)


def test_retrainings_equal_to_the_driving_network_are_accepted_and_worse_ones_are_not():
    margin = 0.15  # of a network whose misses are drawn anew, on so few scenes
    assert judge(run(10), margin=margin).accepted
    assert not judge(run(11, found=0.5), margin=margin).accepted


def test_the_number_of_scenes_decides_by_the_rule_of_z_tests():
    rng, error, effect = np.random.default_rng(0), 0.02, 0.02
    scenes = plan_scenes(effect, error, 30, 0.05)
    assert scenes is not None
    draws = rng.normal(effect, error * np.sqrt(30 / scenes), 20_000)
    assert (draws > 1.645 * error * np.sqrt(30 / scenes)).mean() == pytest.approx(0.8, abs=0.02)
    assert plan_scenes(0, error, 30) is None


def test_an_own_class_without_objects_is_undecided():
    data = [VerificationData("d", "a" * 64, "grid", 1, 24, 24)]
    frames = run(1)[PLAIN]
    domain = replace(describe(frames), objects={"Car": 200, "Pedestrian": 100, "Cyclist": 2})
    found = decide_on_candidate(read_candidate_like(), run(1), run(1), data, domain)
    assert found.undecided
    assert found.reasons == ("2 objects of the class Cyclist, and 10 are wanted",)
    assert found.frames_to_decide == 120


def describe(_: ConditionResults):
    odd = OddCoverage("urban", None, ("junction", "visibility"), {"inside": 24}, 0.5, {})
    own = (("grid",), ("everyday traffic",), ("clear",), None, None, None, (0, 1), (0, 1), {}, ("lidar",))
    return VerifiedDomain(*own, odd)


def test_a_domain_of_frames_without_objects_and_weather_says_so(recorded_frame: Frame, tmp_path: Path):
    known = recorded_frame.annotations
    moves, rest = (known.velocity[:0], known.acceleration[:0]), (known.returns[:0], known.occlusion[:0])
    nothing = replace(recorded_frame, annotations=Annotations(known.track[:0], known.boxes[:0], *moves, *rest))
    found = []
    for name, frame, boxes in (("one", recorded_frame, known.boxes), ("none", nothing, known.boxes[:0])):
        record(Drives(frame, 2), tmp_path / name)
        frames = [VerificationFrame(tmp_path / name, number, "grid", "everyday traffic") for number in range(2)]
        none = Boxes.empty()
        truths = [FrameTruth(f"s{i}", boxes, none, none, None, weather) for i, weather in enumerate(("fog", None))]
        found.append(describe_domain(frames, truths, ["car"], describe(run(1)[PLAIN]).odd))
    one, none = found
    assert (one.speed_m_s, one.distance_m, one.objects) == ((10.0, 10.0), (10.0, 10.0), {"car": 2})
    assert (none.speed_m_s, none.distance_m, none.objects) == ((0.0, 0.0), (0.0, 0.0), {"car": 0})
    assert (one.weathers, one.visibility_m, one.lidars) == (("fog",), None, ("lidar",))


def test_scenes_of_the_training_are_found_by_manifest_and_by_town_and_seed():
    test = VerificationData("test/data", "c" * 64, "grid", 7, 10, 5)

    def found(**fields: object) -> list[str]:
        known = DataHash.model_validate({"name": "x", "manifest": "d" * 64, "town": "grid", "seed": 8, **fields})
        return [*find_overlap(read_candidate_like().model_copy(update={"data": (known,)}), [test])]

    assert found() == []
    assert found(town="ring", seed=7) == []
    assert found(manifest="c" * 64) == ["training on test scenes: x has those of test/data"]
    assert found(seed=7, split="validation", use="validation") == [
        "validation on test scenes: x has those of test/data"
    ]


def test_files_alone_refuse_a_candidate(parties: Parties):
    folder, driving = parties.candidate(2), parties.folder / "1.safetensors"
    assert [*find_faults(folder, read_candidate(folder), driving, [])] == []
    (folder / CARD).write_text((parties.candidate(1) / CARD).read_text())
    assert "a card of other weights" in next(find_faults(folder, read_candidate(folder), driving, []))
    wrong = next(find_faults(folder, read_candidate(folder), parties.folder / "2.safetensors", []))
    assert wrong.startswith("it is proposed to replace another network")
    with (folder / WEIGHTS).open("r+b") as file:
        file.seek(-4, 2)
        file.write(b"\x00\x00\xc0\x7f")
    (fault,) = find_faults(folder, read_candidate(folder), driving, [])
    assert "another SHA-256" in fault


def test_a_verification_of_other_weights_is_none(parties: Parties):
    found = replace(judge(run(1, scenes=4), scenes=4), candidate=read_candidate(parties.candidate(1)).weights)
    write_verification(parties.candidate(1), found)
    assert read_verification(parties.candidate(1)) == found
    write_verification(parties.candidate(2), found)
    with pytest.raises(InputError, match="is the verification of other weights"):
        read_verification(parties.candidate(2))


def test_conditions_change_points_and_nothing_that_is_to_be_found(recorded_frame: Frame):
    for name, condition in CONDITIONS.items():
        changed = condition(recorded_frame)
        assert (changed.annotations.returns == recorded_frame.annotations.returns).all()
        (before,), (after,) = recorded_frame.lidar.values(), changed.lidar.values()
        assert (len(before) == len(after)) == (name != "drop-out")
        assert not np.array_equal(before, after) or name == "latency"
        again = condition(recorded_frame)
        assert all(
            np.array_equal(one, two) for one, two in zip(changed.lidar.values(), again.lidar.values(), strict=True)
        )
    (points,), (turned,) = (
        each.lidar.values() for each in (recorded_frame, CONDITIONS["miscalibration"](recorded_frame))
    )
    whole = np.c_[points[:, :3], np.ones(len(points))].astype(float)
    origin = np.linalg.lstsq(whole, turned[:, :3], rcond=None)[0][3]  # of the one LiDAR, seen by the other
    np.testing.assert_allclose(origin, (0.0, 0.0, -LIFTED_M), atol=0.1 * LIFTED_M)  # which is above it
    late = CONDITIONS["latency"](recorded_frame).annotations.boxes.center - recorded_frame.annotations.boxes.center
    assert np.allclose(late, (2.0, 0.0, 0.0))


def test_a_description_that_its_files_contradict_is_refused(parties: Parties):
    folder, driving = parties.candidate(2), parties.folder / "1.safetensors"
    candidate = read_candidate(folder)
    hidden = candidate.model_copy(update={"data": (candidate.data[0].model_copy(update={"seed": 6}),)})
    assert [*find_faults(folder, hidden, driving, [])] == [
        "its provenance is another than that of the card in its weights"
    ]
    ledger = Ledger(LinkMegabytes(9, 9))
    ledger.enter(LedgerEntry("pretrain", "objects", "wireless", "up", 1, "cav0", 1000))
    ledger.save(folder / LEDGER)
    cheaper = LedgerSum(stage="pretrain", link="wireless", direction="up", bytes=1)
    described = candidate.model_copy(update={"ledger": sha256(folder / LEDGER), "spent": (cheaper,)})
    assert [*find_faults(folder, described, driving, [])] == ["its description names other megabytes than its ledger"]
    true = described.model_copy(update={"spent": (cheaper.model_copy(update={"bytes": 1000}),)})
    assert [*find_faults(folder, true, driving, [])] == []
    (folder / CARD).write_bytes(b"\xff")
    assert "a card of other weights" in next(find_faults(folder, true, driving, []))


@pytest.mark.parametrize("kind", [torch.bool, torch.float8_e4m3fn, torch.complex64])
def test_weights_of_unusual_numbers_are_refused(kind: torch.dtype, parties: Parties):
    path = parties.folder / "2.safetensors"
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    save_file({name: tensor.to(kind) for name, tensor in load_file(path).items()}, path, metadata)
    with pytest.raises(InputError, match="weights of numbers that are not used here"):
        load_network(OBJECTS, path)
