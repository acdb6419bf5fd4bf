"""The step functions of a run: each loads the results of earlier steps, calls its stage's function, saves the result.

Arguments are JSON values, of which a step's fingerprint is made. Other steps are given by name; `Work.inputs` has their
folders.
"""

from collections.abc import Mapping
from typing import Any

Fields = Mapping[str, Any]  # of a part of a recipe, as JSON
