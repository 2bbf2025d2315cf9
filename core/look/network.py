# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network and its encodings in numpy, for inference; core.flare has the torch version.

Hash tables are stored sparsely, as the sorted rows that training touched: one view needs 128 rows of millions.
"""
from __future__ import annotations

import itertools
import math
import threading
import time
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


GAUSSIANS_PER_BLOCK = 400
"""Gaussians that the network is evaluated for in one go; their activations stay in a processor's cache."""
OPTIMISED_BLAS = ("openblas", "mkl", "accelerate", "blis", "flexiblas", "armpl", "nvpl")
"""Names of libraries whose products of matrices are faster than numpy's einsum."""
MAX_CACHE_BYTES = 64 << 20
"""Most bytes of offsets that are kept: those of some hundred lights of a look."""


def has_optimised_blas(config: Any) -> bool:
    """Return whether numpy was built with one of OPTIMISED_BLAS.

    It depends on the installation alone, so that bakes repeat to the bit. config: numpy's record of its build,
    `numpy.__config__`."""
    if hasattr(config, "CONFIG"):
        name = config.CONFIG.get("Build Dependencies", {}).get("blas", {}).get("name", "")
    else:  # numpy below 1.26
        info = getattr(config, "blas_opt_info", {})
        name = [*info.get("libraries", []), *info.get("extra_link_args", [])]
    return any(library in str(name).lower() for library in OPTIMISED_BLAS)


_uses_blas = has_optimised_blas(vars(np)["__config__"])


def multiply(weights: Floats, columns: Floats, out: Floats | None = None) -> Floats:
    """Return the product (k, n) of weights (k, c) and columns (c, n). out: where to write it.

    Without an optimised BLAS numpy's matmul is slow. Its einsum is several times faster there, provided that each row
    of `columns` is contiguous.
    """
    if _uses_blas:
        return np.asarray(np.matmul(weights, columns, out=out))
    return np.asarray(np.einsum("kc,cn->kn", weights, columns, out=out))


_numbers = itertools.count()
"""Numbers of the networks, for their entries in the cache."""


class Offsets:
    """The offsets of a light's Gaussians for one view; they are shared and must not be changed.

    values: (n, sum of the heads' widths). by_name: (n, width) of each head. deformed: what `LightLook` computes from
    them alone, None until it has.
    """

    def __init__(self, values: Floats, heads: Mapping[str, int]) -> None:
        """heads: widths by name, in the order of the columns."""
        self.values = values
        edges = np.cumsum([0, *heads.values()])
        self.by_name = {name: values[:, start:end] for name, start, end in zip(heads, edges[:-1], edges[1:],
                                                                               strict=True)}
        self.deformed: Any = None

    @property
    def nbytes(self) -> int:
        """Bytes of the offsets and, about as many, of what is computed from them."""
        return 2 * self.values.nbytes


class _OffsetsCache:
    """The offsets that were computed last, by network and features.

    A light that keeps its place in the picture, or several lights at one place, need the network once.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes, self._bytes, self._lock = max_bytes, 0, threading.Lock()
        self._entries: OrderedDict[tuple[int, bytes], Offsets] = OrderedDict()

    def get(self, key: tuple[int, bytes], compute: Callable[[], Offsets]) -> Offsets:
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


class OffsetsBudget:
    """Bounds the time that redraws of many lights spend in the network while the camera moves.

    Each redraw computes new offsets for as many lights as its time allows, those that have waited longest first. It
    draws the others with their last offsets, at their exact places. A redraw of a moving view passes unused time on to
    the next one. A light that takes longer than the time of one redraw is therefore computed in only some redraws, and
    the mean time stays within the limit. At rest, each redraw computes at least one light, until all offsets are
    exact. A light that is drawn for the first time is always computed. For one camera.
    """

    def __init__(self, seconds: float, seconds_at_rest: float = 0.0,
                 clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin without offsets. seconds: for the network in one redraw. seconds_at_rest: the same while view and
        lights are those of the last two redraws; the larger of both holds then. clock: returns seconds."""
        self._seconds, self._seconds_at_rest, self._clock = seconds, max(seconds, seconds_at_rest), clock
        # Number of computations and mean time of one, by number of the network.
        self._costs: dict[int, tuple[int, float]] = {}
        self._unspent_seconds = 0.0  # of earlier redraws
        self._was_at_rest = True  # in the redraw before; the first redraw of a moving view has time for one light
        # Cache key and offsets of each light, by number of its network and its name; the longest waiting first.
        self._offsets: OrderedDict[tuple[int, str], tuple[tuple[int, bytes], Offsets]] = OrderedDict()
        # Cache key of each light in the redraw since `begin`, and in the one before.
        self._drawn: dict[tuple[int, str], tuple[int, bytes]] = {}
        self._drawn_before: dict[tuple[int, str], tuple[int, bytes]] = {}
        self._due: set[tuple[int, str]] = set()
        self._has_repeated = False  # whether the last two redraws had the same view and lights
        self.is_complete = True
        """Whether the redraw since `begin` has exact offsets."""

    def begin(self) -> None:
        """Begin a redraw; forget the lights that the last one did not have."""
        for light in [light for light in self._offsets if light not in self._drawn]:
            del self._offsets[light]
        self._has_repeated, self.is_complete = self._drawn == self._drawn_before, True
        self._drawn, self._drawn_before = {}, self._drawn

    def get(self, light: tuple[int, str], key: tuple[int, bytes], compute: Callable[[], Offsets]) -> Offsets:
        """Return the offsets of a light: newly computed for `key` (features of the current view) if it is the light's
        turn or its first redraw, else its last ones.

        light: number of its network, and its name. compute: computes the offsets for `key`.
        """
        if not self._drawn:  # the first light of a redraw: now it is known whether the view rests
            self._choose_due(self._has_repeated and self._drawn_before.get(light) == key)
        self._drawn[light] = key
        last_key, last_offsets = self._offsets.get(light, (None, None))
        if last_offsets is None or (last_key != key and light in self._due):
            last_key, last_offsets = key, _cache.get(key, lambda: self._measure(light[0], compute))
            self._offsets[light] = last_key, last_offsets
        if last_key == key:
            self._offsets.move_to_end(light)  # it has exact offsets: behind all that wait
        else:
            self.is_complete = False
        return last_offsets

    def _choose_due(self, is_at_rest: bool) -> None:
        """Choose the lights that get exact offsets in this redraw: the longest waiting, as many as its time allows."""
        seconds = self._seconds_at_rest if is_at_rest else self._seconds + self._unspent_seconds
        has_one, cost = is_at_rest or self._was_at_rest, 0.0
        self._was_at_rest = is_at_rest or not self._costs
        self._due = set()
        for light in self._offsets:
            _, cost = self._costs.get(light[0], (0, 0.0))
            if cost > seconds and (self._due or not has_one):
                break
            self._due.add(light)
            seconds = max(seconds - cost, 0.0)
        self._unspent_seconds = 0.0 if is_at_rest else min(seconds, cost)  # no more than a light takes

    def _measure(self, network: int, compute: Callable[[], Offsets]) -> Offsets:
        """Compute offsets, and update the mean time of a computation for the network of this number.

        A network's first computation takes longer and counts only until the second. A slow one counts little once a
        fast one follows.
        """
        began = self._clock()
        offsets = compute()
        seconds = self._clock() - began
        count, mean = self._costs.get(network, (0, 0.0))
        weight = max(0.1, 1 / max(count, 1))
        self._costs[network] = count + 1, min(mean + weight * (seconds - mean), 2 * seconds)
        return offsets


class HashGrid:
    """Multiresolution hash grid over the unit cube (Müller et al. 2022, section 3); see core/flare/encoding.py."""

    def __init__(self, bits: int, growth: float, levels: int, base: int, rows: NDArray[Any],
                 values: NDArray[Any]) -> None:
        """Make a grid from its stored rows.

        bits: log2 of the most rows of a level's table. growth: factor of the resolution from level to level. levels:
        their number. base: resolution of the coarsest. rows (k,): ascending indices of the stored table rows; all
        others are zero. values (k, features): the stored rows."""
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

        For each level they are the values at the eight corners of the point's cell, interpolated trilinearly."""
        resolutions = self._resolutions[:, None]
        scaled = (np.clip(point, 0, 1).astype(np.float32)[None] * resolutions.astype(np.float32))
        cell = np.minimum(np.floor(scaled), resolutions.astype(np.float32) - 1)  # a point at 1 lies in the last cell
        fraction = (scaled - cell)[:, None]
        corners = cell.astype(np.int64)[:, None] + CORNERS
        weights = np.where(CORNERS.astype(bool), fraction, 1 - fraction).prod(-1)
        side = resolutions + 1
        dense = corners[..., 0] + side * (corners[..., 1] + side * corners[..., 2])
        scrambled = corners * PRIMES
        hashed = (scrambled[..., 0] ^ scrambled[..., 1] ^ scrambled[..., 2]) % self._sizes[:, None]
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
        """Make the network of one light from the tensors of a .flare.

        tensors: by their names in the file, without the light's number. heads: width of each offset by name. levels,
        base: number of levels of the hash grids, and resolution of the coarsest. encoded: (n, d) frequency-encoded
        canonical positions, then latent codes."""
        self._tensors = {name: np.asarray(tensor, np.float32) for name, tensor in tensors.items()
                         if not name.endswith((".rows", ".values"))}
        self._heads, self._range = dict(heads), query_range

        def read_grid(name: str, bits: int, growth: float) -> HashGrid:
            table = f"network.{name}.table.weight"
            return HashGrid(bits, growth, levels, base, tensors[f"{table}.rows"], tensors[f"{table}.values"])

        self._light_grid = read_grid("light_grid", LIGHT_BITS, LIGHT_GROWTH)
        self._camera_grid = read_grid("camera_grid", CAMERA_BITS, CAMERA_GROWTH)
        self._hidden_layers = sorted(name[:-len(".weight")] for name in self._tensors
                                     if name.startswith("network.layers.") and name.endswith(".weight"))
        self._encoded, self._number = encoded, next(_numbers)
        self._last_camera: tuple[bytes, Floats] = (b"", np.zeros(0, np.float32))
        if self._tensors["network.head.weight"].shape[0] != sum(self._heads.values()):
            raise ValueError("the network's heads do not fit the form")

    @cached_property
    def _gaussian_features(self) -> Floats:
        """The Gaussians' contribution to the first layer (width, n), which is independent of the view."""
        return self._encode_gaussians(self._encoded)

    def view_features(self, camera: Floats, light: Floats) -> Floats:
        """Return the features of a camera position (3,), world units, and a light (2,), normalised coordinates.

        Lights that mirror each other in the axes of the picture have the same features."""
        extent = self._range.camera_high - self._range.camera_low
        folded = np.append(np.abs(light), np.linalg.norm(light)).astype(np.float32)
        position = (camera.astype(np.float32) - self._range.camera_low) / extent
        return np.concatenate([self._light_grid(folded / self._range.light_high), self._camera_features(position)])

    def _camera_features(self, position: Floats) -> Floats:
        """Return the features of a camera position (3,) in its range; those of the last one are kept, since all lights
        of a view have them."""
        key = position.tobytes()
        known = self._last_camera
        if known[0] != key:
            known = self._last_camera = key, self._camera_grid(position)
        return known[1]

    def check_shapes(self, *, has_correction: bool) -> None:
        """Evaluate one Gaussian, and delta_l if `has_correction`. Raises ValueError or KeyError for tensors that do not
        fit each other."""
        origin = np.zeros(3, np.float32)
        features = np.concatenate([self._light_grid(origin), self._camera_grid(origin)])
        self._concatenated_offsets(self._encode_gaussians(self._encoded[:1]), features)
        if has_correction and self.light_correction(features).shape != (2,):
            raise ValueError("the correction of the light is no place")

    def offsets(self, features: Floats, budget: OffsetsBudget | None = None, light: str = "") -> Offsets:
        """Return the offsets for the features of a view.

        budget: may return earlier offsets of the placed light of the name `light`."""
        def compute() -> Offsets:
            return Offsets(self._concatenated_offsets(self._gaussian_features, features), self._heads)

        key = self._number, features.tobytes()
        return _cache.get(key, compute) if budget is None else budget.get((self._number, light), key, compute)

    def _encode_gaussians(self, encoded: Floats) -> Floats:
        """Return the contribution of encoded Gaussians (n, d) to the first layer, (width, n)."""
        return multiply(self._tensors["network.gaussian_layer.weight"], np.ascontiguousarray(encoded.T))

    def _concatenated_offsets(self, gaussian_features: Floats, features: Floats) -> Floats:
        """Return the offsets of all heads, (n, sum of their widths).

        gaussian_features (width, n): contribution of each Gaussian to the first layer. features: those of the view.
        """
        from_view = self._linear("network.view_layer", features[:, None])
        count = gaussian_features.shape[1]
        result = np.empty((count, len(self._tensors["network.head.weight"])), np.float32)
        buffers = np.empty((2, len(from_view), min(GAUSSIANS_PER_BLOCK, count)), np.float32)
        for start in range(0, count, GAUSSIANS_PER_BLOCK):
            block = slice(start, min(start + GAUSSIANS_PER_BLOCK, count))
            x, y = buffers[:, :, :block.stop - start]
            np.add(gaussian_features[:, block], from_view, out=x)
            np.maximum(x, 0, out=x)
            for name in self._hidden_layers:
                x, y = self._linear(name, x, y), x  # two buffers, in turn input and output
                np.maximum(x, 0, out=x)
            result[block] = self._linear("network.head", x).T
        return result

    def light_correction(self, features: Floats) -> Floats:
        """Return delta_l (2,), normalised coordinates."""
        hidden = np.maximum(self._linear("network.correction.0", features[:, None]), 0)
        return self._linear("network.correction.2", hidden)[:, 0]

    def _linear(self, name: str, inputs: Floats, out: Floats | None = None) -> Floats:
        """Return the outputs (d, n) of the linear layer of this name for inputs (c, n); out: where to write them."""
        outputs = multiply(self._tensors[f"{name}.weight"], inputs, out)
        outputs += self._tensors[f"{name}.bias"][:, None]
        return outputs
