"""Sensor simulation: rigs, cameras, LiDARs, radars, GNSS and IMU, and the ground truth of each frame."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.sensors.frame import Annotations, Calibration, Frame
    from flcav.sensors.rig import RIGS, Rig

PLACES = {
    "Annotations": "flcav.sensors.frame",
    "Calibration": "flcav.sensors.frame",
    "Frame": "flcav.sensors.frame",
    "RIGS": "flcav.sensors.rig",
    "Rig": "flcav.sensors.rig",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
