"""Positions east, north and up of a first position, from latitude, longitude and height.

Coordinates from the centre of the earth, with latitude phi, longitude lambda and height h:
    X = (nu + h) cos phi cos lambda, Y = (nu + h) cos phi sin lambda, Z = ((1 - e^2) nu + h) sin phi
    nu = a / sqrt(1 - e^2 sin^2 phi), e^2 = f (2 - f)
Reference: coordinate operations 9602 and 9837 of the EPSG (IOGP publication 373-7-2), on the
ellipsoid of WGS 84.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray

# Equatorial radius (m), a (WGS 84).
_RADIUS_M = 6_378_137.0
# Flattening, f (WGS 84).
_FLATTENING = 1.0 / 298.257223563
# Square of the first eccentricity, e^2.
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)
# Smallest distance (m) of a position on the ground from the centre of the earth.
_SMALLEST_M = 6.3e6
# Largest distance (m) of a position in an aircraft from the centre of the earth.
_LARGEST_M = 6.45e6


class LocalOrigin:
    """First position of a stream; the other positions are relative to it.

    Attributes
    ----------
    geodetic : tuple of float or None
        Latitude and longitude (rad) and height (m); None before the first position.
    """

    def __init__(self) -> None:
        self.geodetic: tuple[float, float, float] | None = None

    def local(self, lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray) -> FloatArray:
        """Return positions (N, 3), m, east, north and up of the first position of all calls."""
        if self.geodetic is None:
            self.geodetic = float(lat_rad[0]), float(lon_rad[0]), float(height_m[0])
        origin = np.array(self.geodetic)[:, None]
        from_origin = _earth_centred(lat_rad, lon_rad, height_m) - _earth_centred(*origin)
        # These sums round a single position, as in live use, like many positions; a matrix product
        # would not.
        terms = from_origin[:, :, None] * _axes(*origin[:2])
        return np.asarray(terms[:, 0] + terms[:, 1] + terms[:, 2])


def are_earth_centred(positions: FloatArray) -> bool:
    """Whether all positions (N, 3), m, may be relative to the centre of the earth."""
    distances = np.linalg.norm(positions, axis=1)
    return bool(((distances > _SMALLEST_M) & (distances < _LARGEST_M)).all())


def axes_of_places(positions: FloatArray) -> FloatArray:
    """Return the axes east, north and up (N, 3, 3), as columns, at positions (N, 3), m.

    The positions are relative to the centre of the earth. The latitude is that of Bowring 1976,
    with errors of at most 1e-9 rad on the ground.
    """
    x, y, z = positions.T
    from_axis = np.hypot(x, y)
    polar_radius = _RADIUS_M * (1.0 - _FLATTENING)
    second_eccentricity_2 = _ECCENTRICITY_2 / (1.0 - _ECCENTRICITY_2)
    reduced = np.arctan2(z * _RADIUS_M, from_axis * polar_radius)
    up = z + second_eccentricity_2 * polar_radius * np.sin(reduced) ** 3
    out = from_axis - _ECCENTRICITY_2 * _RADIUS_M * np.cos(reduced) ** 3
    return _axes(np.arctan2(up, out), np.arctan2(y, x))


def rotations_to_first(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) from the axes of each position to those of the first one.

    The axes are east, north and up.
    """
    axes = _axes(lat_rad, lon_rad)
    return axes[0].T @ axes


def _earth_centred(lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return positions (N, 3), m, from the centre of the earth along its axes."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    normal = _RADIUS_M / np.sqrt(1.0 - _ECCENTRICITY_2 * sin_lat**2)
    from_axis = (normal + height_m) * cos_lat
    along_axis = ((1.0 - _ECCENTRICITY_2) * normal + height_m) * sin_lat
    return np.stack([from_axis * np.cos(lon_rad), from_axis * np.sin(lon_rad), along_axis], axis=1)


def _axes(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Return the axes east, north and up (N, 3, 3), as columns, in the axes of the earth."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    sin_lon = np.sin(lon_rad)
    cos_lon = np.cos(lon_rad)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat_rad)], axis=1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=1)
    return np.stack([east, north, up], axis=2)
