"""tools/kill_federation.py: stage III, with vehicles in client processes, ends as if nothing had been killed."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

TOOL = Path(__file__).parents[2] / "tools" / "kill_federation.py"
FEW: dict[str, int] = {"scenes": 1, "spins": 1, "cavs": 2}
RECIPE = {
    "splits": dict.fromkeys(("pool", "validation", "registry", "edge"), FEW) | {"test": FEW | {"scenes": 2}},
    "training": {"steps": 2, "local_steps": 2},
    "tasks": {"weather": {"plan": {"samples": 2, "edge_rounds": 3, "cloud_rounds": 2}}},
    "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate", "vehicles": 2}},
    "budgets_mb": {"wireless": 90, "wireline": 90},
    "placement": {"rule": "none"},
    "recording": {"warmup_s": 5.0, "weather": "clear"},
}


@pytest.mark.slow
def test_a_killed_federation_ends_as_an_undisturbed_one(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    asked = [str(path), "--out", str(tmp_path / "out"), "--kills", "1", "--jobs", "2", "--stage", "cloud"]
    done = subprocess.run([sys.executable, TOOL, *asked], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("1 kills, ")
    assert ", 0 of them otherwise than an undisturbed one" in done.stdout


def test_noise_by_secrets_is_refused_before_anything_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "run.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump(RECIPE | {"federation": {"privacy": {"clip": 1, "noise": 1}}}))
    monkeypatch.setattr(sys, "argv", [str(TOOL), str(path), "--out", str(out), "--kills", "1"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TOOL), run_name="__main__")
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith("'privacy.seeded' repeats it\n")
    assert not out.exists()
