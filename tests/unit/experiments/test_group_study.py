"""The study of groups: who meets what, who asks, and what federations have within the same megabytes."""

import numpy as np
import pytest

from flcav.reproductions.federation.drives import CLASSES, Drives, Pictures
from flcav.reproductions.federation.groups.run import (
    ALIKE,
    DRAWN,
    GROUP,
    MEGABYTES,
    REQUESTS,
    ROSTER,
    UNLIKE,
    WHOLE,
    call,
    draw,
    keep,
    score,
)
from flcav.reproductions.federation.groups.vehicles import MEET, PRETRAIN_SCENES, RARE, open_fleet


def made_drives() -> Drives:
    """Return drives of ten vehicles in six scenes, whose pictures are their class with noise."""
    rng = np.random.default_rng(4)
    centres = rng.normal(size=(CLASSES, 120)).astype(np.float32)

    def pictures(scenes: int) -> Pictures:
        labels = np.tile(np.arange(CLASSES), scenes)
        noise = 0.7 * rng.normal(size=(len(labels), 120))
        names = tuple(f"{scene}" for scene in range(scenes) for _ in range(CLASSES))
        return Pictures((np.maximum(centres[labels] + noise, 0)).astype(np.float32), labels, names)

    return Drives({f"cav{number}": pictures(6) for number in range(10)}, pictures(5))


DRIVES = made_drives()


def test_pretraining_lacks_the_rare_weathers_and_three_vehicles_meet_them() -> None:
    fleet = open_fleet(DRIVES, 1, alike=False, held_back=0.25)
    assert len(fleet.meet) == MEET
    for name, own in fleet.whole.items():
        assert set(map(int, own.scenes)) == set(range(PRETRAIN_SCENES, 6))
        assert bool(np.isin(own.labels, RARE).any()) == (name in fleet.meet)
        assert len(fleet.train[name].labels) + len(fleet.held[name].labels) == len(own.labels)
    assert open_fleet(DRIVES, 2, alike=False, held_back=0.25).meet != fleet.meet
    assert len(open_fleet(DRIVES, 1, alike=True, held_back=0.25).meet) == 10


@pytest.mark.slow
@pytest.mark.parametrize("setting", [UNLIKE, ALIKE])
def test_those_that_meet_what_the_network_does_not_know_ask_and_the_group_spends_less(setting: str) -> None:
    fleet = open_fleet(DRIVES, 1, alike=setting == ALIKE, held_back=0.25)
    followed = {GROUP: call(fleet, 1), ROSTER: keep(fleet, 1), DRAWN: draw(fleet, 1)}
    group, roster, drawn = (followed[name] for name in (GROUP, ROSTER, DRAWN))
    assert set(group.asked) == set(fleet.meet)
    most = REQUESTS.most
    assert most is not None
    assert len(group.members) == most
    assert set(group.members[:MEET]) <= set(group.asked)  # the fourth is called where three ask
    update = roster.up_bytes[1] / 10
    assert drawn.up_bytes[1] == pytest.approx(most * update)
    offers = group.up_bytes[0]
    assert 0 < offers < update
    assert group.up_bytes[1] - offers == pytest.approx(most * update, rel=0.02)  # and what losses take
    found, marks = score(followed, DRIVES)
    at = found[GROUP].at
    assert at is not None
    assert at[MEGABYTES] == at[WHOLE] == pytest.approx(marks[WHOLE, GROUP].mean())
    ends = {name: own.last_within(group.up_bytes[-1]) for name, own in followed.items()}
    assert ends[ROSTER] < ends[DRAWN] <= len(group.weights)
    assert found[ROSTER].accuracy[0] == found[GROUP].accuracy[0] < 0.8  # of a network that lacks two of eight
    assert found[GROUP].accuracy[-1] > found[GROUP].accuracy[0]
