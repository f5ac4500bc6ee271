"""Positions in axes east, north and up at a first position, from latitude, longitude and height.

Coordinates X, Y, Z relative to the centre of the earth (ECEF), from latitude phi, longitude lambda
and height h above the ellipsoid with equatorial radius a and flattening f:
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


class LocalOrigin:
    """Origin of a stream's local coordinates: its first position.

    Attributes
    ----------
    geodetic : tuple of float or None
        Latitude and longitude (rad) and height (m); None before the first position.
    """

    def __init__(self) -> None:
        self.geodetic: tuple[float, float, float] | None = None

    def local(
        self, lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray
    ) -> FloatArray:
        """Return positions (N, 3), m, in the axes east, north and up at the origin.

        The first call sets the origin to its first position.
        """
        if self.geodetic is None:
            self.geodetic = (
                float(lat_rad[0]),
                float(lon_rad[0]),
                float(height_m[0]),
            )
        origin_lat, origin_lon, origin_height = np.array(self.geodetic)[:, None]
        positions = _earth_centred(lat_rad, lon_rad, height_m)
        from_origin = positions - _earth_centred(
            origin_lat, origin_lon, origin_height
        )
        # Multiply vectors (N, 3) by axes (1, 3, 3) as a sum. The sum has equal bits for one
        # position (live) and for many positions, unlike a matrix product.
        terms = from_origin[:, :, None] * _axes(origin_lat, origin_lon)
        return terms[:, 0] + terms[:, 1] + terms[:, 2]


def axes_of_places(positions: FloatArray) -> FloatArray:
    """Return the axes east, north and up (N, 3, 3), as columns, at positions (N, 3), m.

    Positions and axes are in ECEF. Latitudes are computed by the method of Bowring 1976, with
    errors of at most 1e-9 rad on the ground.
    """
    x, y, z = positions.T
    # Distance from the axis of the earth.
    from_axis = np.hypot(x, y)
    polar_radius = _RADIUS_M * (1.0 - _FLATTENING)
    second_eccentricity_2 = _ECCENTRICITY_2 / (1.0 - _ECCENTRICITY_2)
    # Reduced latitude.
    reduced = np.arctan2(z * _RADIUS_M, from_axis * polar_radius)
    up = z + second_eccentricity_2 * polar_radius * np.sin(reduced) ** 3
    out = from_axis - _ECCENTRICITY_2 * _RADIUS_M * np.cos(reduced) ** 3
    return _axes(np.arctan2(up, out), np.arctan2(y, x))


def rotations_to_first(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) from the axes at each position to those at the first.

    The axes are east, north and up.
    """
    axes = _axes(lat_rad, lon_rad)
    return axes[0].T @ axes


def _earth_centred(
    lat_rad: FloatArray, lon_rad: FloatArray, height_m: FloatArray
) -> FloatArray:
    """Return positions (N, 3), m, in ECEF, by the formulas of this module."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    # Radius of curvature nu in the prime vertical.
    normal = _RADIUS_M / np.sqrt(1.0 - _ECCENTRICITY_2 * sin_lat**2)
    from_axis = (normal + height_m) * cos_lat
    along_axis = ((1.0 - _ECCENTRICITY_2) * normal + height_m) * sin_lat
    return np.stack(
        [from_axis * np.cos(lon_rad), from_axis * np.sin(lon_rad), along_axis],
        axis=1,
    )


def _axes(lat_rad: FloatArray, lon_rad: FloatArray) -> FloatArray:
    """Return the axes east, north and up (N, 3, 3), as columns, in ECEF."""
    sin_lat = np.sin(lat_rad)
    cos_lat = np.cos(lat_rad)
    sin_lon = np.sin(lon_rad)
    cos_lon = np.cos(lon_rad)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat_rad)], axis=1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=1)
    return np.stack([east, north, up], axis=2)
