"""Roll-outs: shares that nest, shadow runs that stop, roll-backs that rise, and delivery that is priced."""

import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from release_parties import ALL, Parties

from flcav.config import InputError
from flcav.fleet.releases import ShadowReport
from flcav.geometry import Boxes
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.network.radio.budget import Radio, lone_rate_bps
from flcav.network.radio.links import RadioLinks
from flcav.releases.candidate import CANDIDATE, WEIGHTS, read_candidate
from flcav.releases.repositories.metadata import Directive, is_assigned
from flcav.releases.repositories.repository import publish
from flcav.releases.rollout.deployed import share_of
from flcav.releases.rollout.simulated_fleet import deliver_release
from flcav.releases.rollout.stages import (
    STAGES,
    change_share,
    count_agreed,
    judge_shadows,
    next_share,
    read_directive,
    roll_back,
)
from flcav.storage.files import sha256


def report(vehicle: str, agreed: int) -> ShadowReport:
    return ShadowReport(vehicle, "objects", "a", "b", 10, 100, 100, agreed)


def test_a_larger_share_includes_the_vehicles_of_a_smaller_one():
    fleet = [f"car{number}" for number in range(2000)]
    chosen = [
        {name for name in fleet if is_assigned(name, "objects", Directive(release=3, share_ppm=round(share * ALL)))}
        for share in STAGES
    ]
    assert all(few < many for few, many in pairwise(chosen))
    assert [len(each) / len(fleet) for each in chosen] == pytest.approx(STAGES, abs=0.02)
    other = {name for name in fleet if is_assigned(name, "objects", Directive(release=4, share_ppm=50_000))}
    assert other != chosen[1]  # other canaries for every release


@pytest.mark.parametrize(("count", "reached"), [(1, (1, 1, 1)), (3, (2, 2, 2)), (30, (2, 2, 6)), (300, (3, 15, 60))])
def test_shares_of_a_fleet_are_rounded_up_and_two_at_least(count: int, reached: tuple[int, ...], parties: Parties):
    names, candidate = [f"car{number}" for number in range(count)], read_candidate(parties.candidate(2))
    for stage, wanted in zip(STAGES, (*reached, count), strict=True):
        share = share_of(stage, names, candidate)
        directive = Directive(release=2, share_ppm=round(share * ALL))
        assert sum(is_assigned(name, "objects", directive) for name in names) == wanted


def test_a_stop_is_one_for_vehicles_that_were_named_too(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2, Directive(release=2, share_ppm=0, vehicles=("cav0",)))
    change_share(parties.director, "objects", 0.0, parties.keys("director", 1, 2))
    publish(parties.director)
    installed = parties.update()
    assert installed is not None
    assert installed.release == 1


def test_shadow_runs_decide():
    fine = judge_shadows([report(f"car{number}", 90 + number % 3) for number in range(10)])
    assert fine.judgement == "go on"
    assert fine.mean == pytest.approx(0.09, abs=0.01)
    assert next_share(0.01, fine) == 0.05
    assert next_share(1.0, fine) == 1.0
    bad = judge_shadows([report(f"car{number}", 20 + number % 3) for number in range(10)])
    assert bad.judgement == "stop"
    assert next_share(0.2, bad) == 0.0
    mixed = judge_shadows([report("car0", 95), report("car1", 30)])
    assert mixed.judgement == "wait"
    assert next_share(0.05, mixed) == 0.05


def test_shadow_runs_of_other_networks_or_twice_are_refused():
    for reports, reason in (
        ([], "no shadow run"),
        ([report("a", 1), report("a", 2)], "twice"),
        ([report("a", 1), replace(report("b", 1), candidate="c")], "different networks"),
    ):
        with pytest.raises(InputError, match=reason):
            judge_shadows(reports)


def test_boxes_agree_by_class_and_place():
    def boxes(x: float, label: str) -> Boxes:
        return Boxes(
            np.array([[x, 0, 0.0]]), np.array([[4.0, 2, 1.5]]), np.zeros(1), np.array([label]), score=np.ones(1)
        )

    assert count_agreed(boxes(10, "Car"), boxes(10.5, "Car")) == 1
    assert count_agreed(boxes(10, "Car"), boxes(13, "Car")) == 0
    assert count_agreed(boxes(10, "Car"), boxes(10, "Cyclist")) == 0


def test_a_share_is_signed_and_reaches_the_vehicle(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2, Directive(release=2, share_ppm=0))
    installed = parties.update()
    assert installed is not None
    assert installed.release == 1
    _, state = change_share(parties.director, "objects", 1.0, parties.keys("director", 1))
    assert not state.complete
    with pytest.raises(InputError, match="1 of 2 signatures of the customer"):
        publish(parties.director)
    change_share(parties.director, "objects", 1.0, parties.keys("director", 2), revoke=["car9"])
    change_share(parties.director, "objects", 1.0, parties.keys("director", 1), revoke=["car9"])
    publish(parties.director)
    assert read_directive(parties.director, "objects").revoked == ("car9",)
    installed = parties.update()
    assert installed is not None
    assert installed.release == 2


def test_a_rollback_has_a_rising_number(parties: Parties):
    for party in ("image", "director"):
        parties.release(party, 2)
    parties.update()
    driving = sha256(parties.candidate(2) / WEIGHTS)
    with pytest.raises(InputError, match="a number above 1"):
        roll_back(parties.candidate(1), 1, "It brakes.", parties.candidate(3), driving)
    roll_back(parties.candidate(1), 3, "It brakes.", parties.candidate(3), driving)
    for party in ("image", "director"):
        parties.release(party, 3)
    installed = parties.update()
    assert installed is not None
    assert (installed.release, installed.weights) == (3, read_candidate(parties.candidate(1)).weights)


def test_an_older_release_under_a_new_number_is_no_release(parties: Parties):
    parties.release("image", 2)
    older = parties.candidate(3)
    shutil.copytree(parties.candidate(1), older)
    description = read_candidate(older).model_copy(update={"release": 3, "changes": "Much better."})
    (older / CANDIDATE).write_text(description.model_dump_json())
    with pytest.raises(InputError, match="has the weights of release 1; a roll-back says so"):
        parties.release("image", 3)


def test_delivery_takes_as_long_as_the_rate_says_and_is_priced():
    radio, time_s = Radio(shadowing=False), np.arange(0, 20.1, 0.1)
    shape = (len(time_s), 2, 1)
    loss = np.full(shape, 90.0)
    loss[:, 1] = 300.0  # the second vehicle has no coverage
    links = RadioLinks(
        radio, time_s, ("cav0", "cav1"), ("pole0",), np.full(shape, 50.0), np.zeros(shape, np.int8), loss
    )
    ledger, size = Ledger(LinkMegabytes(0, 0)), 4_000_000
    first, second = deliver_release(links, links.vehicle, 7, size, NetworkSettings(radio=radio), ledger)
    rate = float(lone_rate_bps(links.received_dbm[0, 0], radio)[0])
    shared_s = NetworkSettings().rounds.outage_s  # until the second gives up, each has half of the band
    assert first.at_s == pytest.approx(8 * size / rate + shared_s / 2, rel=1e-6)
    assert (first.bytes, first.attempts, first.reason) == (size, 1, "")
    assert second.at_s is None
    assert second.attempts > 1
    assert second.reason == "the trace ends"
    assert ledger.used_bytes("wireless", direction="down") == size
    assert ledger.used_bytes("wireline", direction="down") == size  # once to the unit
    assert {entry.stage for entry in ledger} == {"release"}
    assert ledger.used_bytes() == 0
