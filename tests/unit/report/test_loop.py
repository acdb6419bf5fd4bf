"""The animation of a run: its frames, seconds and bytes, what each act shows, and the megabytes of its rounds."""

from pathlib import Path

import numpy as np
import pytest
from made_up_run import changes
from PIL import Image, ImageSequence

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.report.pages import loop_film
from flcav.report.pages.loop_film import list_rounds, save_frames
from flcav.report.pictures.changes import GONE
from flcav.report.pictures.loop import ACTS, SIZE, Loop, LoopRound, _View, draw_loop, find_shares
from flcav.report.style import BLUE, ORANGE
from flcav.runs.results.run import Run
from flcav.world.trace import Trace, find_instant

DEMO = Path(__file__).parents[3] / "reproductions" / "runs" / "demo"


def drive(actors: int = 3, instants: int = 5) -> Trace:
    """Return a drive along x, 10 m an instant, a lane apart."""
    at = np.zeros((instants, actors, 3))
    at[..., 0], at[..., 1] = 10.0 * np.arange(instants)[:, None], 3.0 * np.arange(actors)
    none = np.zeros((instants, actors))
    return Trace(
        "grid",
        np.arange(float(instants)),
        np.array(["cav0", "veh1", "ped2"][:actors]),
        np.array(["car", "car", "pedestrian"][:actors]),
        np.zeros(actors, np.int64),
        np.tile((4.5, 1.8, 1.5), (actors, 1)),
        np.ones((instants, actors), bool),
        at,
        none,
        np.zeros((instants, actors, 3)),
        np.zeros((instants, actors, 3)),
        none,
        np.zeros(0, np.str_),
        np.zeros((instants, 0), np.str_),
    )


def loop() -> Loop:
    made = changes()
    sent = [{"wireless": 10.0 * n, "wireline": 5.0 * n} for n in range(4)]
    rounds = tuple(LoopRound(f"Round {n}", 0.4 + 0.03 * n, sent[n], ("cav0",), n == 3) for n in range(4))
    shares = np.linspace(0.05, 0.95, len(made.errors))
    return Loop(
        *("grid", "objects", "AP50", 30, made, shares, 2, drive(), drive(), rounds),
        budgets_mb={"wireless": 80.0, "wireline": 40.0},
    )


@pytest.fixture(scope="module")
def frames() -> list[Image.Image]:
    return [*draw_loop(loop())]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["loop.webp", "loop.gif"])
def test_the_animation_lasts_eight_seconds_and_is_small(frames: list[Image.Image], tmp_path: Path, name: str):
    save_frames(frames, tmp_path / name)
    assert (tmp_path / name).stat().st_size <= 3_000_000
    with Image.open(tmp_path / name) as film:
        assert film.info["loop"] == 0
        lasts = []
        for shown in ImageSequence.Iterator(film):
            shown.load()
            assert shown.size == (960, 540)
            lasts.append(shown.info["duration"])
    assert sum(lasts) == 8000
    assert 40 < len(lasts) <= sum(ACTS) == 96


@pytest.mark.slow
def test_an_animation_that_would_be_too_large_is_coarser_or_refused(
    frames: list[Image.Image], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    some, sizes = frames[:6], []
    save_frames(some, tmp_path / "fine.webp")
    sizes.append((tmp_path / "fine.webp").stat().st_size)
    monkeypatch.setattr(loop_film, "MOST_BYTES", sizes[0] - 1)
    save_frames(some, tmp_path / "coarse.webp")
    assert (tmp_path / "coarse.webp").stat().st_size < sizes[0]
    monkeypatch.setattr(loop_film, "MOST_BYTES", 100)
    with pytest.raises(InputError, match="even in the coarsest quality"):
        save_frames(some, tmp_path / "none.webp")
    assert not (tmp_path / "none.webp").exists()


def colour_at(frame: Image.Image, at: np.ndarray) -> tuple[int, ...]:
    """Return the colour of a picture at x, y [m] on its map."""
    view = _View.around(loop().changes.town.roads)
    x, y = np.array(view.place(at)) / 2
    assert 0 < x < SIZE
    return frame.getpixel((round(x), round(y)))  # type: ignore[return-value]


def near(colour: tuple[int, ...], wanted: str) -> bool:
    return max(abs(a - int(wanted[k : k + 2], 16)) for a, k in zip(colour, (1, 3, 5), strict=True)) < 40


@pytest.mark.slow
def test_errors_pop_up_come_into_sight_and_are_gone(frames: list[Image.Image]):
    made = loop().changes
    crowd = np.linalg.norm(made.errors[:, None, :2] - np.r_[made.errors, made.new][None, :, :2], axis=2)
    alone = (np.sort(crowd, axis=1)[:, 1] > 8) & (made.kind == "miss")  # one of which nothing else is drawn nearby
    gone = next(row for row in np.flatnonzero(alone & ~made.remains) if loop().share[row] > 0.3)
    first, driven, last = frames[0], frames[ACTS[0] - 1], frames[-1]
    assert not near(colour_at(first, made.errors[gone]), ORANGE)
    assert near(colour_at(driven, made.errors[gone]), ORANGE)
    assert near(colour_at(last, made.errors[gone]), GONE)
    (name, *_) = made.viewsheds
    edge = made.poles[name] + (0.0, 6.0, 0.0)  # beside the pole's number
    assert not near(colour_at(driven, edge), BLUE)
    assert near(colour_at(frames[ACTS[0] + ACTS[1] - 1], edge), BLUE)


def test_an_error_is_made_when_its_road_user_is_nearest():
    trace = drive()
    assert find_instant(trace, "veh1", (29.0, 3.0)) == 3
    assert find_instant(trace, "veh9", (29.0, 3.0)) is None
    shares = find_shares({"a": trace}, ["a", "b"], ["veh1", "veh1"], np.array([(29.0, 3.0, 0.0), (0.0, 0.0, 0.0)]))
    assert shares.tolist() == pytest.approx([0.95 * 3 / 4, 0.95])


def test_megabytes_add_up_to_what_was_sent():
    """In the committed demo, whose ledger has them."""
    made = Run.load(DEMO)
    rounds = [*list_rounds(made, "grid", "objects")]
    assert [each.name for each in rounds[:2]] == ["Pretraining", "Edge FL, round 1"]
    for link, use in made.arms["main"].links.items():
        sent = [each.sent_mb[link] for each in rounds]
        assert sent[-1] == pytest.approx(use.used_mb)
        assert sent == sorted(sent)
    (watched,) = (each for each in made.watched if (each.stage, each.region) == ("edge", "grid"))
    scores = [each.score for each in watched.rounds if each.round > 0]
    assert [each.score for each in rounds if each.name.startswith("Edge")] == scores
    assert all(each.clients and each.clients[0].startswith("cav") for each in rounds[1:])
    assert [each.cloud for each in rounds] == [each.name.startswith("Cloud") for each in rounds]


def test_what_cannot_be_animated_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for arguments, told in (
        (["--animate", "loop.mp4"], "end the name with .webp or .gif"),
        (["--animate", "loop.gif"], "results.json"),
        (["--animate", "loop.gif", "--save", "scene.rrd"], "has no use for --save"),
    ):
        with pytest.raises(SystemExit) as stopped:
            command(["view", str(tmp_path), *arguments])
        assert stopped.value.code == 2
        assert told in capsys.readouterr().err
