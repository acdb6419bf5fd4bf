"""What a step's code is: editing what it reaches changes it, editing anything else does not."""

import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Collection
from pathlib import Path

import pytest
from studies import STUDIES

from flcav.experiments.study import record_split
from flcav.runs.engine.source_hash import PACKAGES, Sources, find_definitions
from flcav.runs.recipe import Federation
from flcav.runs.stages import centralised, federating, recording, testing

TOY = {
    "__init__.py": """
        from toy.lazy import lazy_names
        PLACES = {"Hidden": "toy.shapes", "Other": "toy.other"}
        __getattr__ = lazy_names(__name__, PLACES)
        """,
    "lazy.py": "def lazy_names(name, places): return places.get",
    "shapes/__init__.py": """
        from toy.shapes.boxes import Box
        from toy.shapes.round import round
        from toy.shapes.hidden import Hidden
        """,
    "shapes/boxes.py": """
        import math
        from typing import TYPE_CHECKING
        if TYPE_CHECKING:
            from toy.typed import Typed
        SIDES = {}
        SIDES["box"] = 4
        class Box:
            def area(self): return SIDES["box"] * math.pi
        def unused(): return 1
        """,
    "shapes/round.py": """
        def round(): return 3
        """,
    "shapes/hidden.py": "class Hidden: pass",
    "other.py": "class Other: pass",
    "typed.py": "class Typed: pass",
    "late.py": "def late(): return 1",
    "whole.py": """
        FIRST = 1
        SECOND = 2
        """,
    "work.py": """
        import toy.whole
        from toy import Hidden, whole as all_of_it
        from toy.shapes import Box, round as rounded
        REGISTRY = []
        REGISTRY.append(1)
        def step(): return Box().area(), inner(), Hidden
        def inner():
            from toy.late import late
            return late()
        def one(): return toy.whole.FIRST
        def any_of_it(): return getattr(all_of_it, "SECOND")
        def circle(): return rounded()
        TABLE = {"other": "toy.other:Other"}
        def by_name(name): return find(TABLE[name])
        if __name__ == "__main__":
            circle()
        """,
}


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    for name, text in TOY.items():
        path = tmp_path / "toy" / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(textwrap.dedent(text))
    return tmp_path / "toy"


def hashes(folder: Path, name: str = "step") -> dict[str, str]:
    return Sources({"toy": folder}).hashes([("toy.work", name)])


def edited(folder: Path, name: str, change: Callable[[str], str]) -> None:
    text = (folder / name).read_text()
    (folder / name).write_text(change(text))
    assert change(text) != text


def test_a_step_reaches_definitions_through_packages_that_hand_them_on(toy):
    assert set(hashes(toy)) == {"toy.work", "toy.shapes.boxes", "toy.shapes.hidden", "toy.late"}
    assert set(hashes(toy, "one")) == set(hashes(toy, "any_of_it")) == {"toy.work", "toy.whole"}
    assert set(hashes(toy, "circle")) == {"toy.work", "toy.shapes.round"}
    assert set(hashes(toy, "by_name")) == {"toy.work", "toy.other"}
    assert list(find_definitions({"strategy": "toy.other:Other", "note": "at 12:30"})) == [("toy.other", "Other")]
    with_settings = Federation.model_validate({"strategy": {"toy.other:Other": {"share": 0.5}}})
    assert ("toy.other", "Other") in set(find_definitions(with_settings))


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("shapes/boxes.py", "* math.pi", "+ math.pi"),
        ("shapes/boxes.py", '"] = 4', '"] = 5'),
        ("shapes/boxes.py", "import math", "import cmath as math"),
        ("shapes/hidden.py", "pass", "x = 1"),
        ("late.py", "return 1", "return 2"),
        ("work.py", "append(1)", "append(2)"),
        ("__init__.py", '"toy.shapes"', '"toy.shapes.boxes"'),
        ("shapes/__init__.py", "boxes import Box", "hidden import Hidden as Box"),
    ],
)
def test_what_is_reached_counts(toy, file, old, new):
    before = hashes(toy)
    edited(toy, file, lambda text: text.replace(old, new))
    assert hashes(toy) != before


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("shapes/boxes.py", "def unused(): return 1", "def unused(): return 2"),
        ("shapes/boxes.py", "class Box:", '# a comment\nclass Box:\n    """A box."""\n\n'),
        ("shapes/boxes.py", "toy.typed import Typed", "toy.other import Other"),
        ("shapes/round.py", "3", "4"),
        ("typed.py", "pass", "x = 1"),
        ("other.py", "pass", "x = 1"),
        ("whole.py", "FIRST = 1", "FIRST = 9"),
        ("work.py", "return rounded()", "return 2 * rounded()"),
        ("work.py", "    circle()", "    print(circle())"),
        ("__init__.py", '"Other": "toy.other"', '"Other": "toy.other", "More": "toy.late"'),
        ("lazy.py", "places.get", "places.__getitem__"),
        ("work.py", "from toy.shapes import Box, round as rounded", "from toy.shapes.boxes import Box"),
    ],
)
def test_what_is_not_reached_does_not_count_and_neither_do_words(toy, file, old, new):
    before = hashes(toy)
    edited(toy, file, lambda text: text.replace(old, new))
    assert hashes(toy) == before


def test_one_constant_of_a_module_is_reached_or_all_where_the_module_is_passed_on(toy):
    one, all_of_it = hashes(toy, "one"), hashes(toy, "any_of_it")
    edited(toy, "whole.py", lambda text: text.replace("SECOND = 2", "SECOND = 9"))
    assert hashes(toy, "one") == one
    assert hashes(toy, "any_of_it") != all_of_it


STEPS = {
    "recording": record_split,
    "frames": recording.record_step,
    "pretraining": centralised.pretrain_step,
    "evaluation": testing.test_step,
    "stages II and III": federating.federate_step,
} | {f"{name}, {part}": getattr(study, part) for name, study in STUDIES.items() for part in ("learn", "test")}

OF_STUDIES = ("objects", "weather")  # modules with what a study trains, or measures beyond its task


def count_lines(package: Path, modules: Collection[str]) -> int:
    """Return the lines of source of modules of a package; of none, of the whole package."""
    files = [path.relative_to(package).with_suffix("") for path in package.rglob("*.py")]
    named = {".".join((package.name, *(part for part in path.parts if part != "__init__"))): path for path in files}
    chosen = [path for name, path in named.items() if not modules or name in modules]
    return sum(len((package / path).with_suffix(".py").read_text().splitlines()) for path in chosen)


@pytest.mark.parametrize("run", STEPS.values(), ids=STEPS.keys())
def test_no_step_reaches_the_drawing_of_results_or_the_command_line(run):
    reached = Sources().hashes(find_definitions(run))
    assert len(reached) > 50
    assert count_lines(PACKAGES["flcav"], reached) < 0.51 * count_lines(PACKAGES["flcav"], [])
    assert not [name for name in reached if name.startswith(("flcav.report", "flcav.cli"))]
    assert not [name for name in reached if name.startswith("flcav.runs.engine.run")]
    experiments = {name for name in reached if name.startswith(("flcav.experiments", "flcav.reproductions"))}
    assert experiments <= {"flcav.experiments.study", *(f"flcav.reproductions.task_{name}.run" for name in OF_STUDIES)}
    observing = [name for name in reached if name.startswith(("flcav.sensors.rendering", "flcav.sensors.observe"))]
    assert bool(observing) == (run in (record_split, recording.record_step))


@pytest.mark.slow
def test_an_edit_of_flcav_makes_stale_what_it_should(tmp_path):
    copy = tmp_path / "flcav"
    shutil.copytree(PACKAGES["flcav"], copy, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors", "towns"))

    def changed(file: str) -> set[str]:
        path = copy / file
        text = path.read_text()
        before = {name: Sources({"flcav": copy}).hashes(find_definitions(run)) for name, run in STEPS.items()}
        path.write_text(text.replace("return ", "return 0 or "))
        after = {name: Sources({"flcav": copy}).hashes(find_definitions(run)) for name, run in STEPS.items()}
        path.write_text(text)
        return {name for name in STEPS if before[name] != after[name]}

    assert {"pretraining", "stages II and III", "objects, learn"} <= (by_loss := changed("perception/objects/loss.py"))
    assert by_loss.isdisjoint({"recording", "frames", "weather, learn", "signs, test"})
    assert {"recording", "frames"} <= changed("sensors/lidar/lidar.py")
    for drawing in (copy / "report").glob("*.py"):
        assert not changed(f"report/{drawing.name}")
        break


@pytest.mark.slow
def test_everything_that_a_step_loads_of_flcav_and_runs_is_among_what_it_reaches(tmp_path):
    """Modules that the interpreter runs code of while sensors observe a frame, by its own account."""
    code = """
        import sys
        from pathlib import Path
        from flcav.experiments.study import record_split
        from flcav.runs.engine import Work
        from flcav.experiments.study import record_split
        from flcav.runs.engine import Work
        ran = set()
        def trace(frame, event, argument):
            name = frame.f_globals.get("__name__", "")
            if name.startswith("flcav.") and frame.f_code.co_name != "<module>":
                ran.add(name)
        recipe = dict(town="suburb", seed=4, scenes=1, warmup_s=9.0, spins_per_scene=1, every_s=1.0, cavs=1)
        settings = dict(channels=4, azimuth_steps=90)
        recipe["vehicle_rig"] = dict(lidars=dict(lidar=dict(mount=dict(z=1.8), settings=settings)))
        sys.setprofile(trace)
        record_split(Work(Path(sys.argv[1]), {}, lambda *told: None), recipe)
        sys.setprofile(None)
        print(*sorted(ran))
        """
    command = [sys.executable, "-c", textwrap.dedent(code), tmp_path / "split"]
    done = subprocess.run(command, env=os.environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ran = set(done.stdout.split())
    assert len(ran) > 30
    assert ran <= Sources().hashes(find_definitions(record_split)).keys()


def test_a_recording_reaches_what_drives_the_traffic_in_a_process_beside_it():
    reached = Sources().hashes(find_definitions(record_split))
    assert {
        "flcav.world.traffic.process",
        "flcav.world.scenarios.director",
    } <= reached.keys()
