"""Distances on the globe."""

from __future__ import annotations

import numpy as np

EARTH_RADIUS_KM = 6371.0


def great_circle_km(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Kilometres along the globe between points of latitude and longitude in degrees, float64 [..., 2] to [...]."""
    (lat, lon), (lat2, lon2) = np.radians(here).T, np.radians(there).T
    haversine = np.sin((lat2 - lat) / 2) ** 2 + np.cos(lat) * np.cos(lat2) * np.sin((lon2 - lon) / 2) ** 2
    return (2 * EARTH_RADIUS_KM * np.arcsin(np.sqrt(np.clip(haversine, 0, 1)))).T
