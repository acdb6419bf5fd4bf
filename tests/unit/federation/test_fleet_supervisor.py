"""Ctrl-C that is pressed again and again ends a supervisor, and a command, once and without a traceback."""

import signal
import subprocess
import sys
import time

import pytest

SUPERVISOR = """
import sys, time
from pathlib import Path
from flcav.fleet.supervisor import supervise
supervise(Path(sys.argv[1]), {"sleep": lambda: time.sleep(60)}, is_up=lambda: print("ready", flush=True) or True)
"""
COMMAND = """
import sys, time
from flcav.cli import main
@main.app.command()
def linger():
    print("ready", flush=True)
    try:
        time.sleep(60)
    finally:
        time.sleep(0.5)
sys.argv = ["flcav", "linger"]
main.run()
"""


@pytest.mark.parametrize(
    ("script", "code", "said"), [(SUPERVISOR, 0, ""), (COMMAND, 130, "flcav: interrupted\n")], ids=["fleet", "command"]
)
def test_interrupted_ten_times(script, code, said, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    for _ in range(10):
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        time.sleep(0.03)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (code, said)
