"""What `import flcav` gives: names at no cost, each explained with an example that runs."""

import ast
import doctest
import shutil
import subprocess
import sys
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest

import flcav
from flcav import Dataset, Recipe, record

ROOT = Path(__file__).parents[2]
PACKAGES = ("world", "sensors", "sources", "dataset", "network", "perception", "federation", "optimization")
CAMERA = {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 160, "height": 96}}
LIDAR = {"mount": {"z": 1.8}, "settings": {"channels": 32, "azimuth_steps": 600}}
RECIPE = {
    **{"town": "grid", "cavs": 2, "spins_per_scene": 2, "every_s": 4.0, "warmup_s": 20.0},
    "vehicle_rig": {"lidars": {"lidar": LIDAR}, "cameras": {"front": CAMERA}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the working directory of the examples: recipes as in the repository, and a small dataset."""
    folder = tmp_path_factory.mktemp("examples")
    record(Recipe.model_validate(RECIPE), folder / "data")
    shutil.copytree(ROOT / "recipes", folder / "recipes")
    return folder


def told(name: str) -> str:
    """Return the docstring of a name; of a constant, its module's."""
    found = getattr(flcav, name)
    if callable(found) or ismodule(found):
        return found.__doc__ or ""
    return import_module(f"flcav.perception.{name.lower()}").__doc__ or ""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "run" else []) for name in flcav.__all__]
)
def test_the_example_of_each_name_runs(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch):
    text = told(name)
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert any(name in each.source for each in example.examples)
    assert text.split(".")[0].strip()
    monkeypatch.chdir(folder)
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    said: list[str] = []
    doctest.DocTestRunner(optionflags=flags).run(example, out=said.append)
    assert not said, "".join(said)


def after(code: str) -> list[str]:
    """Return what a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_importing_flcav_imports_little_and_takes_little():
    code = "import sys, time; t = time.process_time(); import flcav; dir(flcav); print(time.process_time() - t, "
    seconds, *heavy = after(code + "*{'torch', 'numpy', 'pydantic'} & set(sys.modules))")
    assert heavy == []
    assert float(seconds) < 0.3


def test_torch_stays_out_of_what_does_not_learn():
    packages = ("geometry", "world", "sensors", "sources", "dataset", "network", "optimization")
    code = f"import sys\nfor name in {packages}: exec(f'from flcav.{{name}} import *')\n"
    assert after(f"{code}print('torch' in sys.modules, 'Dataset' in globals(), 'allocate' in globals())") == [
        "False", "True", "True",
    ]  # fmt: skip
    assert after("import sys, flcav; flcav.TASKS; print('torch' in sys.modules)") == ["False"]


@pytest.mark.parametrize("package", ["flcav", *(f"flcav.{name}" for name in PACKAGES)])
def test_each_package_gives_the_names_that_it_tells_readers_of_types(package: str):
    module = import_module(package)
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    typed = {name.name: each.module for each in block.body if isinstance(each, ast.ImportFrom) for name in each.names}
    assert typed == module.PLACES
    assert set(module.__all__) <= set(dir(module))
    for name, place in module.PLACES.items():
        assert getattr(module, name) is getattr(import_module(place), name)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'poetry'"):
        _ = module.poetry


def test_a_name_stays_once_it_was_asked_for():
    assert vars(flcav)["Dataset"] is Dataset
