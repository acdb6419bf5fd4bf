"""3D object detection in LiDAR point clouds (SECOND): network, labels, training samples, evaluation."""

from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second, second, second_paper, second_tiny
from flcav.perception.objects.predict import detect, detect_all
from flcav.perception.objects.samples import Sample, sample_from_frame

__all__ = [
    "Sample",
    "Second",
    "SecondConfig",
    "detect",
    "detect_all",
    "sample_from_frame",
    "second",
    "second_paper",
    "second_tiny",
]
