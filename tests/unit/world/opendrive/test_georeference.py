"""Geo-references of maps, with their offsets: places, directions and scales against PROJ, and the fixes recorded."""

import math
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.geometry import pose
from flcav.sensors.navigation import Gnss, measure_position
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.map.parameters import GeoReference
from flcav.world.opendrive.document import MapOffset, describe_map, read_map
from flcav.world.opendrive.georeference import locate_origin
from flcav.world.opendrive.importing import import_town
from flcav.world.scene import Scene
from flcav.world.trace import Trace

CROSS = Path(__file__).parents[3] / "data" / "cross.xodr"
REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4].parent / "shared" / "data"))
EXACT = Gnss(noise_m=0, noise_up_m=0, bias_m=0, bias_up_m=0)
MUNICH_UTM, MUNICH_WEB = (691_000.0, 5_335_000.0), (1_290_000.0, 6_130_000.0)
WEB = "+a=6378137 +b=6378137 +lat_ts=0 +lon_0=0 +x_0=0 +y_0=0 +k=1 +units=m +nadgrids=@null +wktext +no_defs"
UNDERSTOOD = {
    "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs": MUNICH_UTM,
    "+proj=utm +zone=33 +south +ellps=GRS80": (261_000.0, 6_243_000.0),
    "+proj=utm +zone=32 +lat_0=37 +lon_0=-122 +k_0=1 +x_0=0 +y_0=0 +ellps=GRS80": MUNICH_UTM,  # of UTM, ignored
    "+proj=tmerc +lat_0=48 +lon_0=11 +k=0.9996 +x_0=500000 +y_0=-2e5 +datum=WGS84 +vunits=m": (540_000.0, -190_000.0),
    "+proj=tmerc +lat_0=48 +lon_0=11 +k=2 +k_0=1 +x_0=3 +x_0=4": (700.0, -900.0),
    "+proj=tmerc +lat_0=0 +lon_0=9 +a=6378137.0 +b=6356752.3142 +towgs84=0,0,0,0,0,0,0": (3e5, 5e6),
    "+proj=tmerc +lat_0=-40 +lon_0=179.99": (50_000.0, 0.0),  # beyond 180 degrees
    "+proj=merc +lat_ts=48 +lon_0=11 +k=3 +x_0=1000": (50_000.0, 4_100_000.0),
    "+proj=merc +k=0.7 +lat_0=48 +ellps=WGS84": (900_000.0, -3_000_000.0),
    f"+proj=merc {WEB}": MUNICH_WEB,
    "+proj=merc +lat_ts=48 +R=6378137": (8e5, 4e6),
    "+proj=webmerc +lon_0=10 +x_0=1000 +y_0=5 +datum=WGS84": (5.0, 4e6),
    "EPSG:32632": MUNICH_UTM,
    "epsg:32732": (300_000.0, 6_200_000.0),
    "+init=epsg:32660 +no_defs": MUNICH_UTM,
    "urn:ogc:def:crs:EPSG::32601": MUNICH_UTM,
    "EPSG:25832": MUNICH_UTM,
    "EPSG:26910": (573_650.0, 4_170_359.0),
    "EPSG:3857": MUNICH_WEB,
    "EPSG:3395": MUNICH_WEB,
}
REFUSED = (
    "",
    "<TODO/>",
    "+lat_0=49 +lon_0=8",
    "+proj=lcc +lat_1=49 +lat_2=50 +lon_0=8",
    "+proj=utm +datum=WGS84",
    "+proj=utm +zone=61",
    "+proj=utm +zone=32N",
    "+proj=utm +zone=inf",
    "+proj=tmerc +lat_0=0 +lon_0=9 +x_0=3500000 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7",
    "+proj=tmerc +lat_0=48 +lon_0=11 +units=us-ft",
    "+proj=tmerc +lat_0=48 +lon_0=11 +axis=neu",
    "+proj=tmerc +lat_0=48 +lon_0=11 +pm=paris",
    "+proj=tmerc +lat_0=48 +lon_0=11 +R=6371000",
    "+proj=tmerc +lat_0=48 +lon_0=11 +k=0",
    "+proj=tmerc +lat_0=48 +lon_0=11 +k=1e-9",
    "+proj=tmerc +lat_0=48 +lon_0=11 +x_0=1e12",
    "+proj=tmerc +lat_0=nan +lon_0=11",
    "+proj=merc +R=6371000",
    "+proj=merc +lat_ts=90",
    "EPSG:4326",
    "EPSG:31467",
    "EPSG:32600",
    "EPSG:32661",
    "EPSG:25827",
    "EPSG:23032",
    'PROJCS["WGS 84 / UTM zone 32N",AUTHORITY["EPSG","32632"]]',
)


def by_proj(reference: str, x: float, y: float) -> tuple[float, float]:
    """Return latitude and longitude [deg] of a point of the projection; a grid of heights may not be installed."""
    plane = re.sub(r"\+geoidgrids=\S+", "", reference)
    to_wgs84 = pyproj.Transformer.from_crs(plane, "EPSG:4326", always_xy=True)
    longitude, latitude = to_wgs84.transform(x, y)
    return latitude, longitude


def metres_off(found: np.ndarray, latitude: float, longitude: float) -> float:
    """Return the distance on the ground [m] between two places."""
    return pyproj.Geod(ellps="WGS84").inv(found[1], found[0], longitude, latitude)[2]


@pytest.mark.filterwarnings("ignore:.*init=:FutureWarning")
@pytest.mark.parametrize("reference", UNDERSTOOD)
@pytest.mark.parametrize("hdg", [0.0, 0.7])
def test_a_map_lies_where_proj_says_and_as_it_is_turned(reference: str, hdg: float) -> None:
    x, y = UNDERSTOOD[reference]
    offset = MapOffset(x, y, 512.0, hdg)
    geo = locate_origin(reference, 30.0, -40.0, offset)
    assert geo is not None
    assert geo.altitude_m == 512.0
    for east, north in ((0.0, 0.0), (300.0, 0.0), (0.0, 300.0), (-400.0, 200.0)):
        local = 30.0 + east, -40.0 + north
        world = (  # ASAM OpenDRIVE 1.8, 8.5
            local[0] * math.cos(hdg) - local[1] * math.sin(hdg) + x,
            local[0] * math.sin(hdg) + local[1] * math.cos(hdg) + y,
        )
        found = convert_to_geodetic(geo, np.array((east, north, 0.0)))
        assert metres_off(found, *by_proj(reference, *world)) < 0.03


@pytest.mark.parametrize("reference", REFUSED)
def test_a_reference_of_another_kind_is_none(reference: str) -> None:
    assert locate_origin(reference, *MUNICH_UTM) is None


@pytest.mark.parametrize("offset", [MapOffset(math.nan), MapOffset(z=1e6), MapOffset(hdg=math.inf), MapOffset(1e300)])
def test_an_offset_of_no_place_is_none(offset: MapOffset) -> None:
    assert locate_origin("EPSG:32632", 500_000.0, 5e6, offset) is None


@given(
    latitude=st.floats(-80, 84),
    longitude=st.floats(-180, 180, exclude_max=True),
    x=st.floats(-300_000, 300_000),
    y=st.floats(-300_000, 300_000),
)
@settings(max_examples=100, deadline=None)
def test_any_transverse_mercator_agrees_with_proj(latitude: float, longitude: float, x: float, y: float) -> None:
    reference = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=0.9996 +x_0=-5000 +y_0=700 +datum=WGS84"
    geo = locate_origin(reference, x, y)
    assert geo is not None
    assert metres_off(convert_to_geodetic(geo, np.zeros(3)), *by_proj(reference, x, y)) < 0.001


def test_a_map_on_its_meridian_keeps_its_axes() -> None:
    assert locate_origin("+proj=tmerc +lat_0=48 +lon_0=11", 0.0, 0.0) == GeoReference(
        latitude_deg=48.0, longitude_deg=11.0
    )


def write_cross(path: Path, reference: str, offset: str) -> Path:
    """Write the cross with its coordinates as they are, another geo-reference and an offset."""
    own = "<geoReference><![CDATA[+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs]]></geoReference>"
    text = CROSS.read_text()
    assert own in text
    path.write_text(text.replace(own, f"<geoReference><![CDATA[{reference}]]></geoReference>{offset}"))
    return path


def test_fixes_are_those_of_the_maps_coordinates(tmp_path: Path, standing: Callable[..., Trace]) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    offset = '<offset x="4000000" y="1000" z="500" hdg="0.6"/>'
    imported = import_town(write_cross(tmp_path / "map.xodr", "EPSG:32632", offset), tmp_path / "town")
    town = imported.town
    assert town.parameters.source is not None
    dx, dy = town.parameters.source.offset_m
    scene = Scene(town, standing([("cav0", "car", 3, 10.0, 20.0, 0.4)]))
    for x, y in ((0.0, 0.0), (150.0, -80.0)):
        fix = measure_position(scene, pose(x, y, 1.5), EXACT, np.random.default_rng(0), np.random.default_rng(0))
        u, v = x - dx, y - dy
        world = u * math.cos(0.6) - v * math.sin(0.6) + 4e6, u * math.sin(0.6) + v * math.cos(0.6) + 1e3
        assert metres_off(fix, *by_proj("EPSG:32632", *world)) < 0.01
        assert fix[2] == pytest.approx(501.5, abs=0.01)
    told = "By its geo-reference the town lies at {}° N, {}° E."
    assert told.format(*(round(value, 4) for value in convert_to_geodetic(town.geo, np.zeros(3))[:2])) in imported.notes


@pytest.mark.parametrize(
    ("reference", "told"),
    [
        ("EPSG:31467", "geo-reference 'EPSG:31467' is none of .* the town lies at 49.0° N, 8.4° E"),
        ("EPSG:3857", r"the town lies at 43.\d+° N, 4.\d+° E; a metre there is 1.39 m of the map"),
    ],
)
def test_what_becomes_of_a_reference_is_told(tmp_path: Path, reference: str, told: str) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    notes = import_town(write_cross(tmp_path / "map.xodr", reference, ""), tmp_path / "town").notes
    with pytest.raises(AssertionError, match=told):
        raise AssertionError(" ".join(notes))


def test_the_references_of_real_maps_agree_with_proj() -> None:
    maps = sorted(REAL.rglob("*.xodr"))
    if not maps:
        pytest.skip(f"{REAL} has no maps: they are not part of the project")
    understood = 0
    for path in maps:
        try:
            document = describe_map(read_map(path))
        except InputError:
            continue
        geo = locate_origin(document.geo_reference, 0.0, 0.0, document.offset)
        if geo is None:
            assert "proj=" not in document.geo_reference, path
            continue
        understood += 1
        place = by_proj(document.geo_reference, document.offset.x, document.offset.y)
        assert metres_off(convert_to_geodetic(geo, np.zeros(3)), *place) < 0.001, path
    assert understood >= 1
