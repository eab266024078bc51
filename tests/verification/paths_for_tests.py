"""Paths and settings for tests of the cells along a recorded path: small ones, so that they take a second."""

import numpy as np

from hybridmap.verification.recorded import RecordedPath

FEW = {"modules": 3, "spacing_min_m": 0.12, "spacing_max_m": 0.2, "rectifier": "softplus"}


def there_and_back(side_m=0.5, apart_m=0.02, hz=50.0, speed_m_s=0.2):
    """A path along lines over a square, as stamps (N,), ns, and positions (N, 2)."""
    lines = np.arange(0.0, side_m + 1e-9, apart_m)
    corners = [(x, y) for k, y in enumerate(lines) for x in ((0.0, side_m) if k % 2 == 0 else (side_m, 0.0))]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, way[-1], speed_m_s / hz)
    xy = np.stack([np.interp(at, way, np.array(corners)[:, axis]) for axis in (0, 1)], axis=1)
    return np.round(np.arange(len(at)) * (1e9 / hz)).astype(np.int64), xy + np.array([3.0, -2.0])


def recorded(headings_rad=None, **changes):
    stamps, xy = there_and_back(**changes)
    return RecordedPath(stamps, xy, headings_rad, None, "lines")


def write_csv(path, stamps_ns, xy, header="t,x,y"):
    lines = [f"{stamp / 1e9:.9f},{x:.9f},{y:.9f}" for stamp, (x, y) in zip(stamps_ns, xy, strict=True)]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path
