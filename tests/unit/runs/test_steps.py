import importlib
import json
import os
import platform
import shutil
import signal
import stat
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import flcav
from flcav.config import Config, InputError
from flcav.runs.engine import WHOLE, Step, Work, run_side_by_side, run_steps
from flcav.runs.engine.cluster import packed, replace_folder, stamps
from flcav.runs.engine.run import Pace
from flcav.runs.engine.step import DONE_NOW
from flcav.runs.engine.workers import find_seed
from flcav.runs.provenance import checkout


def count(work: Work, start: int) -> int:
    with (work.folder / "calls").open("a") as file:
        file.write("x")
    return start


def count_arguments(work: Work, **given: object) -> int:
    return len(given)


def add(work: Work, names: list[str]) -> int:
    work.report(1, 2, "halfway")
    return sum(work.result(name) for name in names)


def seeded(work: Work, recipe: dict[str, int]) -> int:
    return recipe["seed"]


def fail(work: Work) -> None:
    raise ValueError("broken step")


def count_threads(work: Work) -> int:
    import torch

    return torch.get_num_threads()


def sleep(work: Work) -> int:
    (work.folder / "started").touch()
    time.sleep(60)
    return 0


def take(work: Work, until: str, processes: int = 1) -> int:
    """Return the workers that the step has, once another step has begun."""
    end = time.monotonic() + 30
    while not (work.folder.parent / until).exists() and time.monotonic() < end:
        time.sleep(0.02)
    return processes


@dataclass(frozen=True)
class Setting:
    share: float = 0.5


@dataclass(frozen=True)
class Other:
    share: float = 0.5


class Checked(Config):
    share: float = 0.5


class CheckedToo(Config):
    share: float = 0.5


class CheckedAround(Config):
    inner: Checked
    seed: int | None = None


@dataclass(frozen=True)
class Around:
    inner: Setting | Other


def refuse(work: Work, setting: Setting | Other) -> None:
    count(work, 0)
    raise ValueError("broken step")


STEPS = [
    Step("a", count, {"start": 1}),
    Step("b", count, {"start": 2}),
    Step("sum", add, {"names": ["a", "b"]}, needs=("a", "b")),
]


def quiet(*_: object) -> None:
    pass


def test_steps_run_once_and_hand_their_values_on(tmp_path):
    assert run_steps(STEPS, tmp_path, jobs=2, notify=quiet) == {"a": 1, "b": 2, "sum": 3}
    assert run_steps(STEPS, tmp_path, jobs=2, notify=quiet)["sum"] == 3
    assert (tmp_path / "a" / "calls").read_text() == "x"


def test_a_step_computes_on_one_thread(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert run_steps([Step("threads", count_threads, {})], tmp_path, jobs=1, notify=quiet) == {"threads": 1}


def test_a_step_has_the_workers_that_no_other_needs(tmp_path):
    steps = [
        Step("first", count, {"start": 1}),
        Step("wide", take, {"until": "second"}, workers=2),
        Step("second", take, {"until": "first"}, ("first",), workers=9),
        Step("both", take, {"until": "first"}, ("second", "wide"), workers=2),
    ]
    assert run_steps(steps, tmp_path, jobs=3, notify=quiet) == {"first": 1, "wide": 2, "second": 1, "both": 2}
    assert run_steps(steps, tmp_path, jobs=1, notify=quiet)["both"] == 2  # done before


def test_what_most_others_wait_for_comes_first(tmp_path):
    steps = [
        Step("alone", count, {"start": 1}, ()),
        Step("first", count, {"start": 1}, ()),
        Step("second", add, {"names": ["first"]}, ("first",)),
        Step("third", add, {"names": ["second"]}, ("second",)),
    ]
    done: list[str] = []
    run_steps(
        steps, tmp_path, jobs=1, notify=lambda name, now, total, note: done.append(name) if note == DONE_NOW else None
    )
    assert done == ["first", "second", "alone", "third"]  # as many wait for "alone" as for "third"


def test_the_seed_of_a_step_is_its_own_or_that_of_what_it_is_given():
    assert find_seed({"settings": CheckedAround(inner=Checked(), seed=7)}) == 7
    assert find_seed({"settings": CheckedAround(inner=Checked()), "recipe": {"seed": 3}}) == 3
    assert find_seed({"around": Around(Setting()), "names": ["seed"]}) is None


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    run_steps(STEPS[:1], tmp_path, jobs=1, notify=quiet)
    with pytest.raises(InputError, match="another configuration"):
        run_steps([Step("a", count, {"start": 5})], tmp_path, jobs=1, notify=quiet)


def edited(budget_mb: float, weight: float = 1.0) -> list[Step]:
    """Return steps of which two are given settings, and one what the first gives."""
    first = Step("first", count_arguments, {"start": 1, "settings": {"budgets_mb": {"wireless": budget_mb}}})
    return [
        first,
        Step("second", count_arguments, {"weight": weight}),
        Step("third", count_arguments, {"need": "first"}, needs=("first",)),
    ]


def test_after_an_edit_the_steps_it_concerns_are_named_with_their_fields_and_done_anew(tmp_path: Path):
    def start(budget_mb: float, weight: float = 1.0, stale: str = "refuse") -> list[str]:
        done: list[str] = []
        run_steps(
            edited(budget_mb, weight),
            tmp_path,
            jobs=1,
            notify=lambda name, now, total, note: done.append(name) if note == DONE_NOW else None,
            stale=stale,
        )
        return done

    assert start(60.0) == ["first", "second", "third"]
    for stale in ("refuse", "keep"):
        with pytest.raises(InputError) as refusal:
            start(80.0, stale=stale)
        assert str(refusal.value) == (
            f"{tmp_path}: did first by another configuration (budgets_mb.wireless: 80.0, was 60.0); third on top of "
            "that; choose another folder, or --stale redo to do that again and keep 1 other step"
        )
    assert start(60.0) == []
    assert start(80.0, stale="redo") == ["first", "third"]
    assert start(80.0, 2.0, stale="redo") == ["second"]
    assert start(80.0, 2.0) == []


def test_a_step_that_was_begun_is_not_gone_on_with_as_another(tmp_path):
    def begun(setting: Setting | Other) -> list[Step]:
        return [Step("a", refuse, {"setting": setting})]

    for attempt in (1, 2):
        with pytest.raises(ValueError, match="broken step"):
            run_steps(begun(Setting()), tmp_path, jobs=1, notify=quiet)
        assert (tmp_path / "a" / "calls").read_text() == "x" * attempt
    for other in (Setting(0.25), Other()):
        with pytest.raises(InputError, match="another configuration"):
            run_steps(begun(other), tmp_path, jobs=1, notify=quiet)
    assert (tmp_path / "a" / "calls").read_text() == "xx"


def test_records_among_the_arguments_are_told_apart_by_class_and_fields():
    settings = (Setting(), Setting(0.25), Other(), Around(Setting()), Around(Other()))
    settings += (Checked(), Checked(share=0.25), CheckedToo(), CheckedAround(inner=Checked(share=0.25)))
    assert len({Step("a", refuse, {"setting": setting}).fingerprint({}) for setting in settings}) == len(settings)
    with pytest.raises(TypeError, match="neither a JSON value nor a record"):
        Step("a", refuse, {"setting": object()}).fingerprint({})


CODE = """
from pathlib import Path
RATE = 2
def learn(work):
    kept = work.folder / "kept"
    kept.write_text((kept.read_text() if kept.exists() else "") + str(RATE))
    if (work.folder.parent / "stop").exists():
        raise ValueError("stopped")
    return RATE
def look(work):
    return 10 * work.result("learn")
def apart(work):
    return 7
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return a module of a user's own, whose source a test can change."""
    (tmp_path / "own_steps.py").write_text(CODE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_steps", raising=False)
    return importlib.import_module("own_steps")


def changed(own: ModuleType, rate: int) -> None:
    assert own.__file__
    Path(own.__file__).write_text(CODE.replace("RATE = 2", f"RATE = {rate}  # a comment"))
    shutil.rmtree(Path(own.__file__).parent / "__pycache__", ignore_errors=True)


def chain(own: ModuleType) -> list[Step]:
    return [Step("apart", own.apart, {}), Step("learn", own.learn, {}), Step("look", own.look, {}, needs=("learn",))]


def told(steps: list[Step], folder: Path, **how: Any) -> list[str]:
    said = []
    run_steps(steps, folder, jobs=1, notify=lambda name, done, total, note: said.append(f"{name} {note}"), **how)
    return [each for each in said if each[:1] != " " and not each.endswith(" ")]  # of steps, not of all of them


def kept(folder: Path) -> dict[str, Any]:
    return {path.parent.name: json.loads(path.read_text()) for path in folder.glob("[a-z]*/done.json")}


REFUSED = (
    "out: did learn by other code (own_steps changed), look on top of other code; choose another folder, or --stale "
    "redo to do that again, or --stale keep to take it as it is"
)


def test_what_other_code_did_is_refused_and_named(own, tmp_path):
    out = tmp_path / "out"
    told(chain(own), out)
    before = kept(out)
    changed(own, 2)  # a comment
    assert told(chain(own), out) == ["apart done before", "learn done before", "look done before"]
    changed(own, 3)
    with pytest.raises(InputError) as refusal:
        told(chain(own), out)
    assert str(refusal.value).endswith(REFUSED)
    assert kept(out) == before
    with pytest.raises(InputError, match="another configuration"):
        told([Step("apart", own.apart, {"more": 1})], out, stale="keep")
    with pytest.raises(InputError, match="stale 'perhaps': choose one of refuse, redo, keep"):
        told(chain(own), out, stale="perhaps")


def test_what_other_code_did_is_done_again_with_all_that_is_built_on_it(own, tmp_path):
    out = tmp_path / "out"
    told(chain(own), out)
    changed(own, 3)
    assert told(chain(own), out, stale="redo") == ["apart done before", "learn done", "look done"]
    assert {name: each["value"] for name, each in kept(out).items()} == {"apart": 7, "learn": 3, "look": 30}
    assert (out / "learn" / "kept").read_text() == "3"  # from an empty folder
    assert sorted(path.name for path in out.iterdir()) == ["apart", "learn", "look"]
    assert told(chain(own), out) == ["apart done before", "learn done before", "look done before"]


def test_what_other_code_did_is_kept_and_stays_known_as_such(own, tmp_path):
    out = tmp_path / "out"
    told(chain(own)[:2], out)
    changed(own, 3)
    assert told(chain(own), out, stale="keep") == ["apart done before", "learn kept, of other code", "look done"]
    assert kept(out)["look"]["value"] == 20
    with pytest.raises(InputError, match=r"learn by other code .own_steps changed., look on top of other code"):
        told(chain(own), out)
    changed(own, 2)  # as it was, and what was built on it
    assert told(chain(own), out) == ["apart done before", "learn done before", "look done before"]


def test_steps_of_a_module_that_has_moved_are_named_and_kept_where_asked(own, tmp_path):
    out = tmp_path / "out"
    told(chain(own)[:2], out)
    for path in out.glob("*/*.json"):  # as an earlier version wrote them
        values = json.loads(path.read_text())
        code = {name.replace("own_steps", "flcav.pipeline.steps.own"): own for name, own in values["code"].items()}
        path.write_text(json.dumps(values | {"code": code, "fingerprint": "of pipeline", "lineage": "of pipeline"}))
    with pytest.raises(InputError, match="did apart, learn by an earlier flcav, whose steps have moved since; choose"):
        told(chain(own), out)
    kept = ["apart kept, of other code", "learn kept, of other code"]
    assert told(chain(own), out, stale="keep") == [*kept, "look done"]
    assert told(chain(own), out, stale="keep") == [*kept, "look done before"]
    with pytest.raises(InputError, match="another configuration"):
        told([Step("apart", own.apart, {"more": 1})], out, stale="keep")


def test_what_other_code_began_is_not_gone_on_with_unasked(own, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "stop").touch()
    with pytest.raises(ValueError, match="stopped"):
        told(chain(own), out)
    (out / "stop").unlink()
    changed(own, 3)
    with pytest.raises(InputError, match="learn by other code"):
        told(chain(own), out)
    told(chain(own), out, stale="keep")
    assert (out / "learn" / "kept").read_text() == "23"
    with pytest.raises(InputError, match="learn by other code"):
        told(chain(own), out)
    told(chain(own), out, stale="redo")
    assert (out / "learn" / "kept").read_text() == "3"


def test_a_link_to_what_other_code_did_is_removed_and_what_it_leads_to_is_not(own, tmp_path):
    out, linking = tmp_path / "out", tmp_path / "linking"
    told(chain(own), out)
    linking.mkdir()
    (linking / "learn").symlink_to(out / "learn", target_is_directory=True)
    changed(own, 3)
    told(chain(own), linking, stale="redo")
    assert kept(linking)["look"]["value"] == 30
    assert kept(out)["look"]["value"] == 20


def test_a_kill_while_steps_are_removed_leaves_none_that_looks_finished(own, tmp_path, monkeypatch):
    out = tmp_path / "out"
    told(chain(own), out)
    changed(own, 3)

    def killed(folder: Path, **how: Any) -> None:
        if folder.name == ".learn.old" and folder.exists():
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            told(chain(own), out, stale="redo")
    assert not (out / "learn").exists()
    with pytest.raises(InputError, match="did look on top of other code"):
        told(chain(own), out)
    assert told(chain(own), out, stale="redo") == ["apart done before", "learn done", "look done"]
    assert sorted(path.name for path in out.iterdir()) == ["apart", "learn", "look"]


def test_folders_of_before_code_was_recorded_are_read_as_asked(own, tmp_path):
    out = tmp_path / "out"
    told(chain(own), out)
    for path in out.glob("*/*.json"):
        values = json.loads(path.read_text())
        path.write_text(json.dumps({name: values[name] for name in ("fingerprint", "value") if name in values}))
    with pytest.raises(InputError, match=r"did apart, learn, look by code that was not recorded; choose"):
        told(chain(own), out)
    assert told(chain(own), out, stale="keep") == [f"{name} kept, of other code" for name in ("apart", "learn", "look")]
    with pytest.raises(InputError, match="another configuration"):
        told([Step("apart", own.apart, {"more": 1})], out, stale="keep")


def keep_two(work: Work, start: int) -> int:
    """Return a number; where the step is done anew, `kept` tells what was there."""
    (work.folder / "below").mkdir(exist_ok=True)
    here = sorted(path.name for path in work.folder.rglob("*") if path.is_file() and path.name != "started.json")
    (work.folder / "kept").write_text(" ".join(here))
    (work.folder / "below" / "numbers").write_text(str(start))
    return start


@pytest.mark.parametrize(("file", "text"), [
    ("below/numbers", None), ("below/numbers", ""), ("done.json", ""), ("done.json", "{"), ("done.json", "[1]"),
    ("done.json", '{"value": 7}'), ("done.json", '{"fingerprint": "of it"}'),
])  # fmt: skip
def test_a_damaged_step_is_told_and_done_anew_and_no_other(tmp_path, file, text):
    after = Step("c", add, {"names": ["a"]}, ("a",))
    steps = [Step("a", keep_two, {"start": 7}), Step("b", count, {"start": 2}), after]
    whole = run_steps(steps, tmp_path, jobs=1, notify=quiet)
    path, told = tmp_path / "a" / file, []
    path.unlink()
    if text is not None:
        path.write_text(text)
    note = lambda step, done, total, note: told.append((step, note)) if step and done in (0, total) and note else None  # noqa: E731
    assert run_steps(steps, tmp_path, jobs=1, notify=note) == whole
    damage = [("a", f"{path} is damaged, the step is done anew")]
    assert sorted(told) == sorted([*damage, ("a", "done"), ("b", "done before"), ("c", "done before")])
    assert (tmp_path / "a" / "below" / "numbers").read_text() == "7"
    assert (tmp_path / "a" / "kept").read_text() == ("kept" if text is None else "kept numbers")
    told.clear()
    assert run_steps(steps, tmp_path, jobs=1, notify=note) == whole
    assert told == [(name, "done before") for name in "abc"]


@pytest.mark.parametrize("text", ["[1]", '{"value": 1}', "{", ""])
def test_a_record_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "done.json").write_text(text)
    with pytest.raises(InputError, match=r"done\.json"):
        run_steps(STEPS, tmp_path, jobs=1, notify=quiet)


def test_a_finished_step_says_by_what_it_was_made(tmp_path):
    run_steps(
        [Step("a", count, {"start": 1}), Step("c", seeded, {"recipe": {"seed": 5}})], tmp_path, jobs=1, notify=quiet
    )
    one, other = (kept(tmp_path)[name]["provenance"] for name in "ac")
    assert (one.pop("seed"), other.pop("seed")) == (None, 5)
    assert one == other
    assert one["threads"] == 1
    assert one["versions"].items() >= {"flcav": flcav.__version__, "python": platform.python_version()}.items()
    assert {"numpy", "torch", "flwr", "scipy"} <= one["versions"].keys()
    assert platform.machine() in one["processor"]


def test_the_revision_is_that_of_the_checkout_that_holds_the_folder(tmp_path):
    def git(*arguments: str) -> str:
        names = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(
            ["git", *names, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    folder, beside = tmp_path / "package", tmp_path / "beside"
    for each in (folder, beside):
        each.mkdir()
        (each / "file.py").write_text("1")
    assert checkout(folder) == (None, False)
    checkout.cache_clear()
    git("init", "-q")
    git("add", "package")
    git("commit", "-qm", "first")
    assert checkout(folder) == (git("rev-parse", "HEAD").strip(), False)
    assert checkout(beside) == (None, False)  # within a checkout, and not of it
    (folder / "file.py").write_text("2")
    checkout.cache_clear()
    assert checkout(folder) == (git("rev-parse", "HEAD").strip(), True)
    checkout.cache_clear()


def test_a_failing_step_ends_the_run_and_keeps_what_was_finished(tmp_path):
    steps = [STEPS[0], Step("broken", fail, {}, needs=("a",)), Step("slow", sleep, {}, needs=("a",))]
    began = time.monotonic()
    with pytest.raises(ValueError, match="broken step"):
        run_steps(steps, tmp_path, jobs=2, notify=quiet)
    assert time.monotonic() - began < 30
    assert (tmp_path / "a" / "done.json").exists()
    assert not (tmp_path / "broken" / "done.json").exists()


@pytest.mark.slow
def test_a_killed_run_goes_on_from_its_last_finished_step(tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[2]); from pathlib import Path; import test_steps as t\n"
        "if __name__ == '__main__':\n"
        "    steps = [t.STEPS[0], t.Step('slow', t.sleep, {}, needs=('a',))]\n"
        "    t.run_steps(steps, Path(sys.argv[1]), jobs=1, notify=t.quiet)\n"
    )
    script = tmp_path / "run.py"
    script.write_text(code)
    command = [sys.executable, str(script), str(tmp_path / "out"), str(Path(__file__).parent)]
    process = subprocess.Popen(command, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (tmp_path / "out" / "slow" / "started").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert run_steps(STEPS, tmp_path / "out", jobs=1, notify=quiet)["sum"] == 3
    assert (tmp_path / "out" / "a" / "calls").read_text() == "x"


def test_runs_side_by_side_take_over_what_another_has_done(tmp_path):
    own = Step("own", count, {"start": 7}), Step("other", count, {"start": 8})
    both = {tmp_path / name: [STEPS[0], each] for name, each in zip(("one", "two"), own, strict=True)}
    values = run_side_by_side(both, jobs=1, notify=lambda *event: None)
    assert [[*each.values()] for each in values.values()] == [[1, 7], [1, 8]]
    first, second = (folder / STEPS[0].name for folder in both)
    assert (first / "calls").read_text() == "x"  # it ran once
    assert (first / "calls").samefile(second / "calls")
    assert (second / "done.json").read_bytes() == (first / "done.json").read_bytes()
    asked_otherwise = {tmp_path / "three": [Step(STEPS[0].name, count, {"start": 3})], tmp_path / "one": [STEPS[0]]}
    assert run_side_by_side(asked_otherwise, jobs=1, notify=lambda *event: None)[tmp_path / "three"] == {"a": 3}


def test_a_step_that_is_under_way_in_another_folder_is_waited_for(tmp_path: Path) -> None:
    runs = {tmp_path / name: STEPS for name in ("one", "two", "three")}
    values = run_side_by_side(runs, jobs=3, notify=quiet)
    assert [*values.values()] == [{"a": 1, "b": 2, "sum": 3}] * 3
    assert {(folder / name / "calls").read_text() for folder in runs for name in "ab"} == {"x"}
    assert all((tmp_path / "one" / name / "calls").stat().st_nlink == 3 for name in "ab")


def test_runs_side_by_side_keep_to_their_own_folders(tmp_path):
    seen = []
    runs = {tmp_path / "one": STEPS, tmp_path / "two": STEPS[:1]}
    values = run_side_by_side(runs, jobs=2, notify=lambda *event: seen.append(event[0]))
    assert values[tmp_path / "one"]["sum"] == 3
    assert values[tmp_path / "two"] == {"a": 1}
    assert {"one/sum", "two/a"} <= set(seen)


def test_files_that_come_from_another_machine_keep_their_permissions(tmp_path: Path) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    (there / "below").mkdir(parents=True)
    (there / "empty").mkdir()
    modes = {"secrets.safetensors": 0o600, "weights.safetensors": 0o644, "below/linked.bin": 0o444}
    for name, mode in modes.items():
        (there / name).write_text(name)
        (there / name).chmod(mode)
    with packed(there, stamps(there)) as pieces:
        (tmp_path / "archive").write_bytes(b"".join(pieces))
    with (tmp_path / "archive").open("rb") as archive:
        replace_folder(here, None, archive)
    assert {name: stat.S_IMODE((here / name).stat().st_mode) for name in modes} == modes
    assert stamps(here).keys() == stamps(there).keys()
    assert all((here / name).read_text() == name for name in modes)


def test_the_number_of_finished_steps_is_told_and_the_time_left(tmp_path):
    told: list[tuple[int, int]] = []

    def notify(name: str, done: int, total: int, note: str) -> None:
        if name == WHOLE:
            told.append((done, total))

    run_steps(STEPS, tmp_path, jobs=1, notify=notify)
    assert told[-1] == (3, 3)
    assert told == sorted(told)
    told.clear()
    run_side_by_side({tmp_path / "one": STEPS[:2], tmp_path / "two": STEPS[:1]}, jobs=1, notify=notify)
    assert told[-1] == (3, 3)  # one of them is taken over


def test_a_step_is_expected_to_take_as_long_as_those_of_its_function():
    pace = Pace(2)
    assert pace.tell_left(STEPS, []) == ""
    pace.add(STEPS[0], 600.0)
    pace.add(STEPS[2], 60.0)
    assert pace.tell_left([], []) == ""
    assert pace.tell_left(STEPS[:2], []) == "about 10 minutes left"  # two of 600 s, by two workers
    assert pace.tell_left(STEPS[:1], [(STEPS[1], 240.0), (STEPS[2], 900.0)]) == "about 8 minutes left"
    assert pace.tell_left([Step("other", print, {})], []) == "about 3 minutes left"  # the mean of all
    assert pace.tell_left([], [(STEPS[2], 30.0)]) == "less than a minute left"
