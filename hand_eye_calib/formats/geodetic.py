"""Latitude, longitude and height as metres east, north and up of the first position.

The formulas are those of the coordinate operations 9602 and 9837 of the EPSG (IOGP publication
373-7-2), on the ellipsoid of WGS 84.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray

# Equatorial radius (m) and flattening.
_RADIUS_M = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
# Distance (m) from the centre of the earth of places on it, and of aircraft.
_LEAST_M = 6.3e6
_MOST_M = 6.45e6


class LocalOrigin:
    """The first position of a stream, from which the others count: ``geodetic`` is its latitude
    and longitude (rad) and height (m), if it is known.
    """

    def __init__(self) -> None:
        self.geodetic: tuple[float, float, float] | None = None

    def local(self, lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray) -> FloatArray:
        """Metres (N, 3) east, north and up of the first position of all that were asked for."""
        if self.geodetic is None:
            self.geodetic = float(lat_rad[0]), float(lon_rad[0]), float(height_m[0])
        origin = np.array(self.geodetic)[:, None]
        from_origin = _earth_centred(lat_rad, lon_rad, height_m) - _earth_centred(*origin)
        # Term by term: a matrix product would round a single position, as live, in another way
        # than many.
        terms = from_origin[:, :, None] * _axes(*origin[:2])
        return np.asarray(terms[:, 0] + terms[:, 1] + terms[:, 2])


def are_earth_centred(positions: FloatArray) -> bool:
    """Whether all positions (N, 3), m, may count from the centre of the earth."""
    distances = np.linalg.norm(positions, axis=1)
    return bool(((distances > _LEAST_M) & (distances < _MOST_M)).all())


def axes_of_places(positions: FloatArray) -> FloatArray:
    """East, north and up (N, 3, 3), as columns, of positions (N, 3), m, from the centre of the
    earth. The latitude is that of Bowring 1976, to 1e-9 rad on the ground.
    """
    x, y, z = positions.T
    from_axis = np.hypot(x, y)
    polar_radius = _RADIUS_M * (1.0 - _FLATTENING)
    eccentricity_2 = _FLATTENING * (2.0 - _FLATTENING)
    second_2 = eccentricity_2 / (1.0 - eccentricity_2)
    reduced = np.arctan2(z * _RADIUS_M, from_axis * polar_radius)
    up = z + second_2 * polar_radius * np.sin(reduced) ** 3
    out = from_axis - eccentricity_2 * _RADIUS_M * np.cos(reduced) ** 3
    return _axes(np.arctan2(up, out), np.arctan2(y, x))


def rotations_to_first(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) from the east, north and up of each position to those of the first."""
    axes = _axes(lat_rad, lon_rad)
    return axes[0].T @ axes


def _earth_centred(lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray) -> FloatArray:
    """Positions (N, 3) along the axes of the earth, from its centre (m)."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    eccentricity_2 = _FLATTENING * (2.0 - _FLATTENING)
    normal = _RADIUS_M / np.sqrt(1.0 - eccentricity_2 * sin_lat**2)
    from_axis = (normal + height_m) * cos_lat
    along_axis = ((1.0 - eccentricity_2) * normal + height_m) * sin_lat
    return np.stack([from_axis * np.cos(lon_rad), from_axis * np.sin(lon_rad), along_axis], axis=1)


def _axes(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """East, north and up (N, 3, 3), as columns, along the axes of the earth."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    sin_lon = np.sin(lon_rad)
    cos_lon = np.cos(lon_rad)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat_rad)], axis=1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=1)
    return np.stack([east, north, up], axis=2)
