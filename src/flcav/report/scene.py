"""The script `scene.js`, which draws sweeps and towns in three dimensions in any page, with three.js inside.

It is the bundle of `planner/web/src/scene`.
"""

from pathlib import Path

SCENE = Path(__file__).with_name("scene.js")
