"""Loader of the Embree 4 C library in the embreex wheel, with typed entry points through ctypes.

API: https://github.com/RenderKit/embree/blob/v4.4.0/README.md (chapter "Embree API").
"""

import ctypes
import importlib.util
import platform
from ctypes import POINTER, c_char_p, c_float, c_int, c_size_t, c_uint, c_void_p
from functools import lru_cache
from pathlib import Path

GEOMETRY_TRIANGLE = 0
GEOMETRY_INSTANCE = 121
BUFFER_INDEX = 0
BUFFER_VERTEX = 1
FORMAT_UINT3 = 0x5003
FORMAT_FLOAT3 = 0x9003
FORMAT_FLOAT3X4_COLUMN_MAJOR = 0x9234
BUILD_QUALITY_HIGH = 2
SCENE_DYNAMIC = 1
QUERY_COHERENT = 1 << 16

SIGNATURES: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (c_void_p, [c_char_p]),
    "rtcGetDeviceError": (c_int, [c_void_p]),
    "rtcNewScene": (c_void_p, [c_void_p]),
    "rtcReleaseScene": (None, [c_void_p]),
    "rtcCommitScene": (None, [c_void_p]),
    "rtcSetSceneFlags": (None, [c_void_p, c_int]),
    "rtcSetSceneBuildQuality": (None, [c_void_p, c_int]),
    "rtcNewGeometry": (c_void_p, [c_void_p, c_int]),
    "rtcReleaseGeometry": (None, [c_void_p]),
    "rtcCommitGeometry": (None, [c_void_p]),
    "rtcAttachGeometry": (c_uint, [c_void_p, c_void_p]),
    "rtcEnableGeometry": (None, [c_void_p]),
    "rtcDisableGeometry": (None, [c_void_p]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [c_void_p, c_int, c_uint, c_int, c_void_p, c_size_t, c_size_t, c_size_t],
    ),
    "rtcSetGeometryInstancedScene": (None, [c_void_p, c_void_p]),
    "rtcSetGeometryTransform": (None, [c_void_p, c_uint, c_int, POINTER(c_float)]),
    "rtcIntersect16": (None, [c_void_p, c_void_p, c_void_p, c_void_p]),
    "rtcOccluded16": (None, [c_void_p, c_void_p, c_void_p, c_void_p]),
}


class IntersectArguments(ctypes.Structure):
    """`RTCIntersectArguments`."""

    _fields_ = (
        ("flags", c_uint),
        ("feature_mask", c_uint),
        ("context", c_void_p),
        ("filter", c_void_p),
        ("intersect", c_void_p),
        ("min_width_distance_factor", c_float),
    )


class OccludedArguments(ctypes.Structure):
    """`RTCOccludedArguments`."""

    _fields_ = (
        ("flags", c_uint),
        ("feature_mask", c_uint),
        ("context", c_void_p),
        ("filter", c_void_p),
        ("occluded", c_void_p),
        ("min_width_distance_factor", c_float),
    )


@lru_cache(maxsize=1)
def embree_library() -> ctypes.CDLL:
    """Return the Embree library, loaded once per process; raises `OSError` where it is not installed."""
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise OSError(
            f"the ray caster needs Embree, and the package embreex is not installed "
            f"(it has no wheel for every machine: this one is {platform.system()} {platform.machine()})"
        )
    package = Path(spec.origin).parent
    folders = (package.parent / "embreex.libs", package / ".dylibs", package)
    for thread_library in _matching(folders, "tbb"):  # TBB must be in memory before Embree is loaded
        ctypes.CDLL(str(thread_library), mode=getattr(ctypes, "RTLD_GLOBAL", 0))
    candidates = _matching(folders, "embree4")
    if not candidates:
        raise OSError(f"the package embreex at {package} carries no Embree 4 library; flcav needs embreex 4.4")
    library = ctypes.CDLL(str(candidates[0]))
    for name, (result, arguments) in SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _matching(folders: tuple[Path, ...], stem: str) -> list[Path]:
    """Return the library files of a name, with or without the prefix "lib", sorted."""
    return sorted(path for folder in folders for prefix in ("lib", "") for path in folder.glob(f"{prefix}{stem}*.*"))
