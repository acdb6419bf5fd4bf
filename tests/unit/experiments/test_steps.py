import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.pipeline.steps import Step, Work, run_side_by_side, run_steps


def count(work: Work, start: int) -> int:
    with (work.folder / "calls").open("a") as file:
        file.write("x")
    return start


def add(work: Work, names: list[str]) -> int:
    work.report(1, 2, "halfway")
    return sum(work.result(name) for name in names)


def fail(work: Work) -> None:
    raise ValueError("broken step")


def count_threads(work: Work) -> int:
    import torch

    return torch.get_num_threads()


def sleep(work: Work) -> int:
    (work.folder / "started").touch()
    time.sleep(60)
    return 0


@dataclass(frozen=True)
class Setting:
    share: float = 0.5


@dataclass(frozen=True)
class Other:
    share: float = 0.5


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


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    run_steps(STEPS[:1], tmp_path, jobs=1, notify=quiet)
    with pytest.raises(InputError, match="another configuration"):
        run_steps([Step("a", count, {"start": 5})], tmp_path, jobs=1, notify=quiet)


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
    assert len({Step("a", refuse, {"setting": setting}).fingerprint({}) for setting in settings}) == len(settings)
    with pytest.raises(TypeError, match="neither a JSON value nor a dataclass"):
        Step("a", refuse, {"setting": object()}).fingerprint({})


def test_a_failing_step_ends_the_run_and_keeps_what_was_finished(tmp_path):
    steps = [STEPS[0], Step("broken", fail, {}, needs=("a",)), Step("slow", sleep, {}, needs=("a",))]
    began = time.monotonic()
    with pytest.raises(ValueError, match="broken step"):
        run_steps(steps, tmp_path, jobs=2, notify=quiet)
    assert time.monotonic() - began < 30
    assert (tmp_path / "a" / "done.json").exists()
    assert not (tmp_path / "broken" / "done.json").exists()


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


def test_runs_side_by_side_keep_to_their_own_folders(tmp_path):
    seen = []
    runs = {tmp_path / "one": STEPS, tmp_path / "two": STEPS[:1]}
    values = run_side_by_side(runs, jobs=2, notify=lambda *event: seen.append(event[0]))
    assert values[tmp_path / "one"]["sum"] == 3
    assert values[tmp_path / "two"] == {"a": 1}
    assert {"one/sum", "two/a"} <= set(seen)
