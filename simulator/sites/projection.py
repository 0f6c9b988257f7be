"""From longitudes and latitudes to metres in a scenario's square area, and back."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Proj

from shared.world.channel import FloatArray

# A line that is straight in degrees is drawn in metres to this distance.
BEND_M = 0.5


@dataclass(frozen=True)
class Frame:
    """The plane of a scenario on the globe: azimuthal equidistant (WGS 84), x metres east and y metres north.

    Distances from the projection's centre are true. Distances across that direction are scaled by ``(r / R) / sin(r /
    R)`` at ``r`` from the centre, with R the Earth's radius of 6371 km: too long by 0.4 millionths at 10 km, 0.004 % at
    100 km, and 0.2 % at 700 km, the corner of the largest area. Poles and the antimeridian need no special case.

    Attributes:
        longitude: of the projection's centre, degrees.
        latitude: of the projection's centre, degrees.
        centre: the scenario's x and y of that point.
    """

    longitude: float
    latitude: float
    centre: tuple[float, float]

    def metres(self, degrees: ArrayLike) -> FloatArray:
        """The x and y, ``(N, 2)`` metres, of longitudes and latitudes ``(N, 2)``."""
        longitude, latitude = np.asarray(degrees, dtype=np.float64).reshape(-1, 2).T
        return np.stack(_plane(self.longitude, self.latitude)(longitude, latitude), axis=-1) + self.centre

    def bent(self, degrees: ArrayLike) -> FloatArray:
        """A line of legs that are straight in degrees (RFC 7946, 3.1.1) with the points between that it has in metres.

        Legs of some kilometres get none. The middle of a leg of length l to the east is about ``l^2 tan(latitude) /
        8 R`` from the straight line in the plane, 900 m for 200 km. A leg between longitudes that are more than 180
        degrees apart crosses the antimeridian.

        Args:
            degrees: longitudes and latitudes, ``(N, 2)``, within some 2,000 km of the centre.
        """
        line = np.array(degrees, dtype=np.float64).reshape(-1, 2)
        shares = np.array([0.25, 0.5, 0.75])[:, None, None]
        while True:
            way = np.diff(line, axis=0)
            way[:, 0] -= np.where(np.abs(way[:, 0]) > 180, np.copysign(360.0, way[:, 0]), 0.0)
            between = line[:-1] + shares * way
            between[..., 0] -= np.where(np.abs(between[..., 0]) > 180, np.copysign(360.0, between[..., 0]), 0.0)
            plane = self.metres(line)
            gaps = self.metres(between).reshape(between.shape) - (plane[:-1] + shares * np.diff(plane, axis=0))
            bends = (np.linalg.norm(gaps, axis=-1) > BEND_M).any(axis=0)
            if not bends.any():
                return line
            line = np.insert(line, np.flatnonzero(bends) + 1, between[1, bends], axis=0)

    def degrees(self, metres: ArrayLike) -> FloatArray:
        """The longitudes and latitudes, ``(N, 2)``, of points ``(N, 2)`` metres."""
        x, y = (np.asarray(metres, dtype=np.float64).reshape(-1, 2) - self.centre).T
        return np.stack(_plane(self.longitude, self.latitude)(x, y, inverse=True), axis=-1)


@lru_cache(maxsize=8)
def _plane(longitude: float, latitude: float) -> Proj:
    return Proj(proj="aeqd", ellps="WGS84", units="m", lon_0=longitude, lat_0=latitude)


def centre_of(degrees: ArrayLike) -> tuple[float, float]:
    """The longitude and latitude of the mean of points ``(N, 2)`` as directions from the Earth's centre, degrees."""
    longitude, latitude = np.asarray(degrees, dtype=np.float64).T
    east, north = np.radians(longitude), np.radians(latitude)
    x, y, z = np.mean((np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)), axis=1)
    # Rounded, since the last bits of the mean depend on how it is summed.
    lon_0, lat_0 = np.degrees((np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))).tolist()
    return round(lon_0, 6), round(lat_0, 6)


def fit_square(points: FloatArray) -> tuple[FloatArray, float]:
    """Move points, ``(N, 2)`` metres, to the middle of the smallest square of whole metres with a corner at 0, 0.

    Returns:
        The points, to the millimetre, and the square's side.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(1.0, float(np.ceil((high - low).max())))
    # Rounding must not put a point past the edge.
    return np.clip(np.round(points - low + (side - (high - low)) / 2, 3), 0.0, side), side
