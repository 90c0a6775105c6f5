"""Where the sun stands at a time and a place: J. Meeus, Astronomical Algorithms, 2nd edition 1998, chapters 12
(sidereal time), 13 (horizontal coordinates), 16 (refraction, Saemundsson) and 25 (position of the sun, lower accuracy:
0.01 degrees). Years 1900 to 2100.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

from splatpainter.kernels import portable
from splatpainter.lights.lamps import Rgb, Sun

TURN = 360.0
J2000 = 2451545.0
"""Julian day of 2000 January 1, 12:00."""
DELTA_T = 70.0
"""Seconds of dynamical over universal time: 64 in 2000, 69 in 2020; a minute moves the sun by 0.0007 degrees."""
YEARS = (1900, 2100)


def solar_coordinates(julian_day: float) -> tuple[float, float, float]:
    """(apparent right ascension, declination, apparent sidereal time at Greenwich), degrees. julian_day: of universal
    time; the sun's place is that of DELTA_T later."""
    t = (julian_day + DELTA_T / 86400 - J2000) / 36525
    longitude = 280.46646 + t * (36000.76983 + 0.0003032 * t)
    anomaly = 357.52911 + t * (35999.05029 - 0.0001537 * t)
    center = (
        (1.914602 - t * (0.004817 + 0.000014 * t)) * _sin(anomaly)
        + (0.019993 - 0.000101 * t) * _sin(2 * anomaly)
        + 0.000289 * _sin(3 * anomaly)
    )
    node = 125.04 - 1934.136 * t  # of the moon's orbit: nutation
    apparent = longitude + center - 0.00569 - 0.00478 * _sin(node)
    mean_obliquity = 23.4392911 - t * (46.8150 + t * (0.00059 - 0.001813 * t)) / 3600
    obliquity = mean_obliquity + 0.00256 * _cos(node)
    ascension = _atan2(_cos(obliquity) * _sin(apparent), _cos(apparent)) % TURN
    declination = _atan2(s := _sin(obliquity) * _sin(apparent), math.sqrt(max(1 - s * s, 0)))
    days = julian_day - J2000
    century = days / 36525
    sidereal = 280.46061837 + 360.98564736629 * days + century * century * (0.000387933 - century / 38710000)
    sidereal += -0.00478 * _sin(node) * _cos(obliquity)
    return ascension, declination, sidereal % TURN


def sun_position(when: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """(azimuth clockwise from north, elevation above the horizon with refraction of a standard atmosphere), in
    degrees. latitude: north positive; longitude: east positive. Raises ValueError: a time without zone, no such place
    or year."""
    if when.tzinfo is None:
        raise ValueError("expected a time with its zone, say 2026-06-21T15:00+02:00 (Z for universal time)")
    if not YEARS[0] <= when.year <= YEARS[1]:
        raise ValueError(f"expected a year from {YEARS[0]} to {YEARS[1]}, got {when.year}")
    if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
        raise ValueError(f"expected latitude -90 to 90 and longitude -180 to 180, got {latitude:g},{longitude:g}")
    seconds = (when.astimezone(UTC) - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds()
    ascension, declination, sidereal = solar_coordinates(J2000 + seconds / 86400)
    hour = sidereal + longitude - ascension
    east = -_cos(declination) * _sin(hour)
    north = _sin(declination) * _cos(latitude) - _cos(declination) * _cos(hour) * _sin(latitude)
    up = _sin(declination) * _sin(latitude) + _cos(declination) * _cos(hour) * _cos(latitude)
    elevation = _atan2(up, math.sqrt(east * east + north * north))
    # Refraction counts near the horizon, where shadows are longest; far below it the formula has no meaning.
    if elevation > -1:
        bent = math.radians(elevation + 10.3 / (elevation + 5.11))
        elevation += 1.02 / 60 * portable.cos(bent) / portable.sin(bent)
    return _atan2(east, north) % TURN, elevation


def sun_at(
    when: datetime,
    latitude: float,
    longitude: float,
    north: float = 0.0,
    *,
    color: Rgb = (1.0, 1.0, 1.0),
    intensity: float = 1.0,
) -> Sun:
    """The sun there and then. north: azimuth (as of cameras and suns, degrees) at which north lies. Raises ValueError:
    as `sun_position`; it has set."""
    azimuth, elevation = sun_position(when, latitude, longitude)
    if elevation < 0:
        raise ValueError(f"the sun is {-elevation:.1f} degrees below the horizon at {when.isoformat()} there")
    return Sun((north - azimuth) % TURN, elevation, color=color, intensity=intensity)


def _sin(degrees: float) -> float:
    return portable.sin(math.radians(degrees % TURN))


def _cos(degrees: float) -> float:
    return portable.cos(math.radians(degrees % TURN))


def _atan2(y: float, x: float) -> float:
    return math.degrees(portable.arctan2(y, x))
