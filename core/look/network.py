# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network and its encodings in numpy, for inference; core.flare has the torch version.

Hash tables are stored sparsely, as the sorted rows that training touched: one view needs 128 rows of millions.
"""
from __future__ import annotations

import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

BANDS = 3
"""Octaves of the frequency encoding of canonical positions."""
LIGHT_BITS, LIGHT_GROWTH, CAMERA_BITS, CAMERA_GROWTH = 17, 1.8, 15, 1.6
"""log2 of the rows of a level's table, and growth of the resolution from level to level, of the two hash grids."""
PRIMES = np.array([1, 2654435761, 805459861], np.int64)
"""Primes of the spatial hash (Müller et al. 2022, eq. 4)."""
CORNERS = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)], np.int64)
"""Corners of a cell, (8, 3)."""


MAX_CACHE_BYTES = 64 << 20
"""Most bytes of offsets that are kept: those of some hundred lights of a look."""

_numbers = itertools.count()
"""Numbers of the networks, for their entries in the cache."""


class _OffsetsCache:
    """The offsets that were computed last, by network and features.

    A light that keeps its place in the picture, or several lights at one place, need the network once.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes, self._bytes, self._lock = max_bytes, 0, threading.Lock()
        self._entries: OrderedDict[tuple[int, bytes], Floats] = OrderedDict()

    def get(self, key: tuple[int, bytes], compute: Callable[[], Floats]) -> Floats:
        """Return the entry of a key, computed where it is missing."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is not None:
                self._entries.move_to_end(key)
                return entry
        entry = compute()
        with self._lock:
            if key not in self._entries:
                self._entries[key] = entry
                self._bytes += entry.nbytes
            while self._bytes > self._max_bytes:
                self._bytes -= self._entries.popitem(last=False)[1].nbytes
        return entry


_cache = _OffsetsCache(MAX_CACHE_BYTES)


class HashGrid:
    """Multiresolution hash grid over the unit cube (Müller et al. 2022, section 3); see core/flare/encoding.py."""

    def __init__(self, bits: int, growth: float, levels: int, base: int, rows: NDArray[Any],
                 values: NDArray[Any]) -> None:
        """bits, growth: see `LIGHT_BITS`. levels, base: see `FlareForm`. rows (k,): ascending indices of the stored
        table rows, the others are zero. values (k, features): the stored rows."""
        size = 1 << bits
        self._resolutions = np.array([math.floor(base * growth**level) for level in range(levels)], np.int64)
        self._sizes = np.minimum((self._resolutions + 1) ** 3, size)
        self._starts = np.concatenate([[0], np.cumsum(self._sizes)[:-1]]).astype(np.int64)
        self._rows, self._values = np.asarray(rows, np.int64), np.asarray(values, np.float32)
        if (self._values.ndim != 2 or self._rows.shape != self._values.shape[:1] or (np.diff(self._rows) <= 0).any()
                or (len(self._rows) and not 0 <= self._rows[0] <= self._rows[-1] < self._sizes.sum())):
            raise ValueError("a hash table's rows are not valid")

    def __call__(self, point: Floats) -> Floats:
        """Return features (levels * features,) of a point (3,), clamped to 0..1.

        They are, for each level, the values at the corners of the point's cell, interpolated linearly."""
        resolutions = self._resolutions[:, None]
        scaled = (np.clip(point, 0, 1).astype(np.float32)[None] * resolutions.astype(np.float32))
        cell = np.minimum(np.floor(scaled), resolutions.astype(np.float32) - 1)  # 1 lies in the last cell
        fraction = (scaled - cell)[:, None]
        corners = cell.astype(np.int64)[:, None] + CORNERS
        weights = np.where(CORNERS.astype(bool), fraction, 1 - fraction).prod(-1)
        side = resolutions + 1
        dense = corners[..., 0] + side * (corners[..., 1] + side * corners[..., 2])
        primed = corners * PRIMES
        hashed = (primed[..., 0] ^ primed[..., 1] ^ primed[..., 2]) % self._sizes[:, None]
        # A level all of whose corners fit its table needs no hash.
        rows = np.where(side**3 <= self._sizes[:, None], dense, hashed) + self._starts[:, None]
        return np.asarray((self._row_values(rows) * weights[..., None]).sum(1).reshape(-1), np.float32)

    def _row_values(self, rows: NDArray[np.int64]) -> Floats:
        """Return the values (..., features) of table rows (...); 0 for those that are not stored."""
        values = np.zeros((*rows.shape, self._values.shape[1]), np.float32)
        if len(self._rows):
            index = np.minimum(np.searchsorted(self._rows, rows), len(self._rows) - 1)
            is_stored = self._rows[index] == rows
            values[is_stored] = self._values[index[is_stored]]
        return values


def frequency_encoding(values: Floats, bands: int = BANDS) -> Floats:
    """Return sin and cos of 2^k pi x for k < bands (Mildenhall et al. 2020, eq. 4): (n, d) to (n, 2 * bands * d)."""
    octaves = (math.pi * 2.0 ** np.arange(bands)).astype(np.float32)
    angles = (values[..., None] * octaves).reshape(len(values), values.shape[1] * bands)
    return np.concatenate([np.sin(angles), np.cos(angles)], -1)


@dataclass(frozen=True)
class QueryRange:
    """The boxes that map camera and light to the unit cube: the range of the training views.

    camera_low, camera_high: world units. light_high: largest |x|, |y|, norm of the light's offset from the
    principal point, normalised image coordinates.
    """

    camera_low: Floats
    camera_high: Floats
    light_high: Floats

    @classmethod
    def read(cls, entry: Mapping[str, Sequence[float]]) -> QueryRange:
        """Read the entry of a .flare's description. Raises ValueError for invalid values."""
        parts = [np.asarray(entry[name], np.float32) for name in ("camera_low", "camera_high", "light_high")]
        if any(part.shape != (3,) or not np.isfinite(part).all() for part in parts):
            raise ValueError("a light's range is not valid")
        return cls(*parts)

    def clip(self, camera: Floats, light: Floats) -> tuple[Floats, Floats]:
        """Clip camera (3,) and light (2,) to the range of the training views.

        The light moves straight towards the principal point."""
        camera = np.clip(camera, self.camera_low, self.camera_high)
        norm = float(np.linalg.norm(light))
        sizes = np.append(np.abs(light), norm)
        with np.errstate(divide="ignore", invalid="ignore"):
            shrink = np.min(np.where(sizes > self.light_high, self.light_high / sizes, 1.0))
        return camera, np.asarray(light * shrink, np.float32)


class Network:
    """The network that computes the offsets of the canonical Gaussians, and delta_l, from one camera and light."""

    def __init__(self, tensors: Mapping[str, NDArray[Any]], heads: Mapping[str, int], levels: int, base: int,
                 query_range: QueryRange, encoded: Floats) -> None:
        """tensors: by their names in the file, without the light's number. heads: width of each offset by name.
        levels, base: see `FlareForm`. encoded: (n, d) frequency-encoded canonical positions, then latent codes."""
        self._tensors = {name: np.asarray(tensor, np.float32) for name, tensor in tensors.items()
                         if not name.endswith(".rows")}
        self._heads, self._range = dict(heads), query_range

        def read_grid(name: str, bits: int, growth: float) -> HashGrid:
            table = f"network.{name}.table.weight"
            return HashGrid(bits, growth, levels, base, tensors[f"{table}.rows"], tensors[f"{table}.values"])

        self._light_grid = read_grid("light_grid", LIGHT_BITS, LIGHT_GROWTH)
        self._camera_grid = read_grid("camera_grid", CAMERA_BITS, CAMERA_GROWTH)
        self._hidden_layers = sorted(name[:-len(".weight")] for name in self._tensors
                                     if name.startswith("network.layers.") and name.endswith(".weight"))
        self._encoded, self._number = encoded, next(_numbers)
        if self._tensors["network.head.weight"].shape[0] != sum(self._heads.values()):
            raise ValueError("the network's heads do not fit the form")

    @cached_property
    def _gaussian_features(self) -> Floats:
        """The Gaussians' contribution to the first layer, which is independent of the view."""
        return self._encode_gaussians(self._encoded)

    def view_features(self, camera: Floats, light: Floats) -> Floats:
        """Return the features of a camera position (3,), world units, and a light (2,), normalised coordinates.

        Lights that mirror each other in the axes of the picture have the same features."""
        extent = self._range.camera_high - self._range.camera_low
        folded = np.append(np.abs(light), np.linalg.norm(light)).astype(np.float32)
        position = (camera.astype(np.float32) - self._range.camera_low) / extent
        return np.concatenate([self._light_grid(folded / self._range.light_high), self._camera_grid(position)])

    def check_shapes(self, *, has_correction: bool) -> None:
        """Evaluate one Gaussian, and delta_l if `has_correction`. Raises ValueError or KeyError for tensors that do not
        fit each other."""
        origin = np.zeros(3, np.float32)
        features = np.concatenate([self._light_grid(origin), self._camera_grid(origin)])
        self._concatenated_offsets(self._encode_gaussians(self._encoded[:1]), features)
        if has_correction and self.light_correction(features).shape != (2,):
            raise ValueError("the correction of the light is no place")

    def offsets(self, features: Floats) -> dict[str, Floats]:
        """Return the offsets by name, (n, width) each; they are shared and must not be changed."""
        all_offsets = _cache.get((self._number, features.tobytes()), lambda: self._concatenated_offsets(
            self._gaussian_features, features))
        edges = np.cumsum([0, *self._heads.values()])
        return {name: all_offsets[:, start:end]
                for name, start, end in zip(self._heads, edges[:-1], edges[1:], strict=True)}

    def _encode_gaussians(self, encoded: Floats) -> Floats:
        """Return the contribution of encoded Gaussians (n, d) to the first layer, (n, width)."""
        return np.asarray(encoded @ self._tensors["network.gaussian_layer.weight"].T, np.float32)

    def _concatenated_offsets(self, gaussian_features: Floats, features: Floats) -> Floats:
        """Return the offsets of all heads, (n, sum of their widths); see `_encode_gaussians` and `view_features`."""
        x = gaussian_features + self._linear("network.view_layer", features[None])
        np.maximum(x, 0, out=x)
        for name in self._hidden_layers:
            x = self._linear(name, x)
            np.maximum(x, 0, out=x)
        return self._linear("network.head", x)

    def light_correction(self, features: Floats) -> Floats:
        """Return delta_l (2,), normalised coordinates."""
        hidden = np.maximum(self._linear("network.correction.0", features[None]), 0)
        return self._linear("network.correction.2", hidden)[0]

    def _linear(self, name: str, inputs: Floats) -> Floats:
        """Return the outputs (n, d) of the linear layer of this name for inputs (n, c)."""
        outputs = inputs @ self._tensors[f"{name}.weight"].T
        outputs += self._tensors[f"{name}.bias"]
        return np.asarray(outputs, np.float32)
