"""Ray casting with Embree 4, in a two-level hierarchy: moving an instance sets its transform and rebuilds no mesh.

There is one Embree device per process. It builds the bounding volume hierarchies on one thread, so that they are the
same in every run. The C library comes from the embreex wheel, and is called through ctypes.
API: https://github.com/RenderKit/embree/blob/v4.4.0/README.md (chapter "Embree API").
"""

import ctypes
import importlib
import importlib.util
import platform
import weakref
from collections.abc import Sequence
from ctypes import POINTER, c_char_p, c_float, c_int, c_size_t, c_uint, c_void_p
from functools import lru_cache
from pathlib import Path

import numpy as np

from flcav.arrays import Array, Array32, Ints, Ints32, Mask
from flcav.geometry import pose
from flcav.machine.threads import share_among_threads
from flcav.world.rays.packets import LANES, Hits, occlude_packets, trace_groups, trace_packets

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
    "rtcSetSharedGeometryBuffer": (None, [c_void_p, c_int, c_uint, c_int, c_void_p, c_size_t, c_size_t, c_size_t]),
    "rtcSetGeometryInstancedScene": (None, [c_void_p, c_void_p]),
    "rtcSetGeometryTransform": (None, [c_void_p, c_uint, c_int, POINTER(c_float)]),
    "rtcIntersect16": (None, [c_void_p, c_void_p, c_void_p, c_void_p]),
    "rtcOccluded16": (None, [c_void_p, c_void_p, c_void_p, c_void_p]),
}


class QueryArguments(ctypes.Structure):
    """`RTCIntersectArguments`, and `RTCOccludedArguments`, which has the same layout."""

    _fields_ = (
        ("flags", c_uint),
        ("feature_mask", c_uint),
        ("context", c_void_p),
        ("filter", c_void_p),
        ("callback", c_void_p),
        ("min_width_distance_factor", c_float),
    )


@lru_cache(maxsize=1)
def embree_library() -> ctypes.CDLL:
    """Return the Embree library, loaded once per process. Raises `OSError` where it is not installed."""
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


_ARGUMENTS = QueryArguments(flags=QUERY_COHERENT, feature_mask=0xFFFFFFFF)


class Hierarchy:
    """A bounding volume hierarchy that rays are traced through: a scene in Embree's terms."""

    handle: int

    def trace(
        self,
        target_from_rays: Array,
        directions: Array32,
        *,
        near_m: Array32 | None = None,
        far_m: float = np.inf,
        threads: int = 1,
    ) -> Hits:
        """Return the first hit of each ray beyond `near_m` (N,) [m], by default 0, and before `far_m` [m].

        All rays start at the origin of one frame, e.g. a sensor's: `target_from_rays` (4, 4) is its pose in the
        hierarchy's frame, `directions` (N, 3) are unit vectors in it. The `threads` threads trace whole packets. Raises
        `ValueError` where `near_m` has another length than `directions`.
        """
        rays, near, hits = _buffers(directions, near_m)
        origin = target_from_rays[:3, 3].astype(np.float32)
        rotation = np.ascontiguousarray(target_from_rays[:3, :3], np.float32)
        frame = (_address("rtcIntersect16"), self.handle, ctypes.addressof(_ARGUMENTS), origin, rotation)

        def part(first: int, last: int) -> None:
            trace_packets(*frame, rays, near, np.float32(far_m), first, last, *hits)

        share_among_threads(part, len(rays), threads, whole=LANES)
        return hits


class Solid(Hierarchy):
    """A triangle mesh with its bounding volume hierarchy, in the mesh frame: the lower level."""

    def __init__(self, vertices: Array32, faces: Ints32) -> None:
        """Build the hierarchy of vertices (V, 3) [m] and faces (F, 3).

        Raises `ValueError` for an empty mesh, `OSError` where Embree is missing or fails.
        """
        if not len(faces):
            raise ValueError("a solid needs at least one face")
        api, device = embree_library(), _device()
        # Embree reads 16 bytes at the last 12-byte vertex: one more vertex keeps that inside the buffer.
        self._vertices = np.concatenate((vertices, vertices[-1:])).astype(np.float32)
        self._faces = np.ascontiguousarray(faces, np.uint32)
        self.handle = api.rtcNewScene(device)
        api.rtcSetSceneBuildQuality(self.handle, BUILD_QUALITY_HIGH)
        geometry = api.rtcNewGeometry(device, GEOMETRY_TRIANGLE)
        for kind, form, array, count in (
            (BUFFER_VERTEX, FORMAT_FLOAT3, self._vertices, len(vertices)),
            (BUFFER_INDEX, FORMAT_UINT3, self._faces, len(faces)),
        ):
            api.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, array.ctypes.data, 0, 12, count)
        api.rtcCommitGeometry(geometry)
        api.rtcAttachGeometry(self.handle, geometry)
        api.rtcReleaseGeometry(geometry)  # the scene keeps it
        api.rtcCommitScene(self.handle)
        _check("building a mesh")
        weakref.finalize(self, api.rtcReleaseScene, self.handle)


class Assembly(Hierarchy):
    """Instances of solids, placed by rigid transforms: the upper level of the hierarchy."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        """Create an instance of every solid, not placed yet; instance i is of solid i."""
        api, device = embree_library(), _device()
        self._solids = tuple(solids)  # kept alive as long as their instances
        self.handle = api.rtcNewScene(device)
        api.rtcSetSceneFlags(self.handle, SCENE_DYNAMIC)
        self._instances: list[int] = []
        for solid in solids:
            instance = api.rtcNewGeometry(device, GEOMETRY_INSTANCE)
            api.rtcSetGeometryInstancedScene(instance, solid.handle)
            api.rtcCommitGeometry(instance)
            api.rtcAttachGeometry(self.handle, instance)
            api.rtcReleaseGeometry(instance)
            api.rtcDisableGeometry(instance)
            self._instances.append(instance)
        _check("placing meshes")
        weakref.finalize(self, api.rtcReleaseScene, self.handle)

    def place(self, instance: int, target_from_body: Array | None) -> None:
        """Place an instance by its pose (4, 4) [m], or remove it (None); this takes effect with `commit`."""
        api, geometry = embree_library(), self._instances[instance]
        if target_from_body is None:
            api.rtcDisableGeometry(geometry)
            return
        columns = (ctypes.c_float * 12)(*target_from_body[:3].T.ravel())
        api.rtcSetGeometryTransform(geometry, 0, FORMAT_FLOAT3X4_COLUMN_MAJOR, columns)
        api.rtcEnableGeometry(geometry)
        api.rtcCommitGeometry(geometry)

    def commit(self) -> None:
        """Rebuild the upper level from the placed instances.

        It must not be called while another thread traces. Raises `OSError` where Embree fails.
        """
        embree_library().rtcCommitScene(self.handle)
        _check("placing meshes")

    def find_occluded(self, origins: Array32, directions: Array32, far_m: Array32, *, threads: int = 1) -> Mask:
        """Return (N,) whether rays are occluded before their ends `far_m` (N,) [m]; never where that is not positive.

        `origins` (N, 3) [m] and unit `directions` (N, 3), or (1, 3) for all, are in the assembly's frame.
        """
        start, towards, far = (np.ascontiguousarray(array, np.float32) for array in (origins, directions, far_m))
        out = np.empty(len(far), np.bool_)
        cast = np.flatnonzero(far > 0)
        arguments = ctypes.addressof(_ARGUMENTS)

        def part(first: int, last: int) -> None:
            at = slice(cast[first] if first else 0, cast[last] if last < len(cast) else len(far))
            aimed = towards if len(towards) == 1 else towards[at]
            occlude_packets(_address("rtcOccluded16"), self.handle, arguments, start[at], aimed, far[at], out[at])

        share_among_threads(
            part, len(cast), threads, whole=LANES
        )  # counted by rays that are cast: same packets for any number
        return out


def trace_each(
    solids: Sequence[Solid],
    solid_from_rays: Array,
    ends: Ints,
    directions: Array32,
    *,
    near_m: Array32 | None = None,
    far_m: float = np.inf,
) -> Hits:
    """Return the first hits of K groups of rays, group k with `solids[k]` alone; `instance` is the group index.

    Group k is `directions[ends[k - 1] : ends[k]]`: unit vectors in a frame whose pose in its solid's frame is
    `solid_from_rays[k]` (4, 4). `near_m` and `far_m` are as in `Assembly.trace`.
    """
    rays, near, hits = _buffers(directions, near_m)
    trace_groups(
        _address("rtcIntersect16"),
        np.array([solid.handle for solid in solids], np.int64),
        ctypes.addressof(_ARGUMENTS),
        np.ascontiguousarray(solid_from_rays[:, :3, 3], np.float32),
        np.ascontiguousarray(solid_from_rays[:, :3, :3], np.float32),
        rays,
        near,
        np.float32(far_m),
        ends,
        *hits,
    )
    return hits


def _buffers(directions: Array32, near_m: Array32 | None) -> tuple[Array32, Array32, Hits]:
    """Return contiguous directions (N, 3) and near distances (N,) or (1,) in single precision, and uninitialised hits.

    Raises `ValueError` where `near_m` has another length than `directions`.
    """
    rays = np.ascontiguousarray(directions, np.float32).view()
    rays.flags.writeable = False  # as some are: Numba compiles the loops for one type only
    near = np.zeros(1, np.float32) if near_m is None else np.ascontiguousarray(near_m, np.float32)
    if near_m is not None and len(near) != len(rays):
        raise ValueError(f"near_m has {len(near)} values for {len(rays)} rays")
    count = len(rays)
    return rays, near, Hits(np.empty(count, np.float32), np.empty(count, np.int32), np.empty(count, np.int32))


@lru_cache(maxsize=1)
def _device() -> int:
    """Return the Embree device of this process. Raises `OSError` where it cannot start."""
    device = embree_library().rtcNewDevice(b"threads=1")
    if not device:
        raise OSError("Embree could not start on this machine")
    return device


@lru_cache(maxsize=2)
def _address(function: str) -> int:
    """Return the address of an Embree function."""
    return ctypes.cast(getattr(embree_library(), function), ctypes.c_void_p).value or 0


def _check(doing: str) -> None:
    """Raise `OSError` if the device has reported an error since the last check."""
    code = embree_library().rtcGetDeviceError(_device())
    if code:
        raise OSError(f"Embree failed with error {code} while {doing}")


@lru_cache(maxsize=1)
def check_embree() -> None:
    """Check Embree once per process by tracing known rays to a known mesh, alone and as a moved instance.

    Raises `OSError` where Embree is missing or a distance is wrong.
    """
    vertices = np.array([[2, -1, -1], [2, 1, -1], [2, 0, 1]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    forward = np.array([[1, 0, 0]], np.float32)
    solid = Solid(vertices, faces)
    assembly = Assembly([solid, solid])
    assembly.place(1, pose(10.0, 5.0, 0.0, yaw=np.pi / 2))  # the face, 2 m ahead of the body, now at (10, 7)
    assembly.commit()
    alone = solid.trace(np.eye(4), forward)
    placed = assembly.trace(pose(10.0, 0.0, 0.0, yaw=np.pi / 2), forward)
    missed = assembly.trace(np.eye(4), forward)
    measured = [float(alone.distance[0]), float(placed.distance[0]), int(placed.instance[0]), int(missed.instance[0])]
    if not np.allclose(measured, [2.0, 7.0, 1, -1], atol=1e-5):
        raise OSError(f"Embree traced a known scene wrongly ({measured}): flcav needs embreex 4.4")
