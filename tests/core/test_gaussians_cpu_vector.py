# SPDX-License-Identifier: GPL-3.0-or-later
"""The vector layer compared with numpy."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba")

import numba

from core.gaussians.cpu import vector as v
from core.gaussians.cpu.compilation import OPTIONS

A = np.random.default_rng(0).normal(0, 3, 16).astype(np.float32)
B = np.random.default_rng(1).normal(0, 3, 16).astype(np.float32)


def run(body: Callable[..., Any], *arrays: np.ndarray, size: int = 16) -> np.ndarray:
    """Return the array that a kernel body(out, *arrays) writes."""
    out = np.zeros(size, np.float32)
    numba.njit(**OPTIONS)(body)(out, *arrays)
    return out


def test_operators_equal_numpy() -> None:
    def body(out, a, b):  # type: ignore[no-untyped-def]
        """Store the results of the operators on the first vectors of a and b, 16 values each."""
        x, y = v.load(a, 0), v.load(b, 0)
        v.store(out, 0, x + y * 2 - 1)
        v.store(out, 16, -x / y)
        v.store(out, 32, v.fma(x, y, 0.5))
        z = x
        z *= y
        z += 1.5
        v.store(out, 48, 2 - z)

    found = run(body, A, B, size=64).reshape(4, 16)
    a, b = A.astype(np.float64), B.astype(np.float64)
    np.testing.assert_allclose(found, [a + b * 2 - 1, -a / b, a * b + 0.5, 0.5 - a * b], rtol=1e-5, atol=2e-6)


def test_comparisons_and_selects_equal_numpy() -> None:
    def body(out, a, b):  # type: ignore[no-untyped-def]
        """Store the results of comparisons and selections, 16 values each, and of two reductions."""
        x, y = v.load(a, 0), v.load(b, 0)
        v.store(out, 0, v.where((x < y) & (x > -1), x, 7))
        v.store(out, 16, v.where((x >= y) | (y <= 0), 1, y))
        v.store(out, 32, v.minimum(x, y))
        v.store(out, 48, v.maximum(x, 0.25))
        v.store(out, 64, v.sqrt(v.absolute(x)))
        out[80] = v.any_of(x > 100)
        out[81] = v.any_of(x == x) if False else v.any_of(x < 100)

    found = run(body, A, B, size=96)
    expected = [
        np.where((A < B) & (A > -1), A, 7), np.where((A >= B) | (B <= 0), 1, B), np.minimum(A, B), np.maximum(A, 0.25),
        np.sqrt(np.abs(A)),
    ]  # fmt: skip
    np.testing.assert_allclose(found[:80].reshape(5, 16), expected, rtol=2e-7)
    assert found[80] == 0 and found[81] == 1


def test_integer_operations_and_conversions_equal_numpy() -> None:
    def body(out, a):  # type: ignore[no-untyped-def]
        n = v.to_ints(v.load(a, 0))
        v.store(out, 0, v.to_floats(((n << 3) + 1 - (n >> 1)) & 0xFF | 2))
        v.store(out, 16, v.as_floats(v.as_ints(v.load(a, 0))))
        v.store(out, 32, v.lane_index())
        v.store(out, 48, v.splat(2.5))

    found = run(body, A, size=64).reshape(4, 16)
    n = A.astype(np.int32)
    np.testing.assert_array_equal(found, [((n << 3) + 1 - (n >> 1)) & 0xFF | 2, A, np.arange(16), np.full(16, 2.5)])


def test_transpose_and_interleave_permute_lanes() -> None:
    def body(out, a):  # type: ignore[no-untyped-def]
        rows = v.transpose(v.load_rows(a, 1, 20))
        v.store_rows(out, 0, 16, rows)
        v.store_rows(out, 256, 16, v.deinterleave((rows[0], rows[1], rows[2])))
        v.store_rows(out, 304, 16, v.interleave((rows[0], rows[1], rows[2])))
        v.store_rows(out, 352, 16, v.interleave((rows[3], rows[4])))
        v.store_rows(out, 384, 16, v.deinterleave(v.interleave((rows[0], rows[1], rows[2], rows[3]))))

    a = np.random.default_rng(2).normal(size=400).astype(np.float32)
    found = run(body, a, size=448)
    transposed = a[1:321].reshape(16, 20)[:, :16].T
    np.testing.assert_array_equal(found[:256].reshape(16, 16), transposed)
    np.testing.assert_array_equal(found[256:304].reshape(3, 16), transposed[:3].reshape(16, 3).T)
    np.testing.assert_array_equal(found[304:352], transposed[:3].T.reshape(-1))
    np.testing.assert_array_equal(found[352:384], transposed[3:5].T.reshape(-1))
    np.testing.assert_array_equal(found[384:448].reshape(4, 16), transposed[:4])


def test_align_lanes_and_multiply_each_equal_numpy() -> None:
    def body(out, a, b):  # type: ignore[no-untyped-def]
        x, y = v.load(a, 0), v.load(b, 0)
        v.store_rows(out, 0, 16, (v.align_lanes(x, y, 0), v.align_lanes(x, y, 5)))
        v.store_rows(out, 32, 16, (v.align_lanes(x, y, 15), v.align_lanes(x, y, 16)))
        v.store_rows(out, 64, 16, v.multiply_each((x, y, x), (y, y, x)))

    found = run(body, A, B, size=112).reshape(7, 16)
    both = np.concatenate([A, B])
    np.testing.assert_array_equal(found[:4], [both[n : n + 16] for n in (0, 5, 15, 16)])
    np.testing.assert_array_equal(found[4:], [A * B, B * B, A * A])


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 10, 16])
def test_reduce_add_each_sums_every_vector(count: int) -> None:
    vectors = "".join(f"v.load(a, {16 * i}), " for i in range(count))
    text = f"def body(out, a):\n    v.store(out, 0, v.reduce_add_each(({vectors})))"
    namespace = {"v": v}
    exec(text, namespace)
    a = np.random.default_rng(3).normal(size=(count, 16)).astype(np.float32)
    found = run(namespace["body"], a.reshape(-1))  # type: ignore[arg-type]
    np.testing.assert_allclose(found[:count], a.astype(np.float64).sum(1), rtol=1e-5, atol=1e-5)


def test_reduce_add_and_load_scalar_equal_numpy() -> None:
    def body(out, a):  # type: ignore[no-untyped-def]
        out[0] = v.reduce_add(v.load(a, 0))
        out[1] = v.load_scalar(a, 5)
        for i in range(0, 4, v.opaque(2)):
            out[2] += i

    np.testing.assert_allclose(run(body, A)[:3], [A.astype(np.float64).sum(), A[5], 2], rtol=1e-5)


def test_the_counter_is_incremented_once_per_call() -> None:
    def body(out, counter):  # type: ignore[no-untyped-def]
        for i in range(16):
            out[i] = v.atomic_increment(counter)

    np.testing.assert_array_equal(run(body, np.zeros(1, np.int64)), np.arange(16))


def test_exponentials_and_logarithm_are_within_their_error_bounds() -> None:
    x = np.linspace(-140, 130, 16 * 4000).astype(np.float32)
    positive = np.exp(np.linspace(-80, 80, 16 * 4000)).astype(np.float32)
    small = np.linspace(-3, 0.5, 16 * 4000).astype(np.float32)

    def body(out, a, b, c):  # type: ignore[no-untyped-def]
        for i in range(0, a.size, 16):
            v.store(out, i, v.exp2(v.load(a, i)))
            v.store(out, i + a.size, v.log2(v.load(b, i)))
            v.store(out, i + 2 * a.size, v.exp2m1(v.load(c, i)))

    exp2, log2, exp2m1 = run(body, x, positive, small, size=3 * x.size).reshape(3, -1)
    inside = (x >= -126) & (x <= 126)
    np.testing.assert_allclose(exp2[inside], np.exp2(x[inside].astype(np.float64)), rtol=3e-7)
    assert (exp2[x < -126] <= 1.2e-38).all() and (exp2[x > 127] >= 2**126).all()
    np.testing.assert_allclose(log2, np.log2(positive.astype(np.float64)), rtol=3e-7, atol=3e-7)
    np.testing.assert_allclose(exp2m1, np.expm1(small.astype(np.float64) * np.log(2)), rtol=4e-7, atol=1e-30)


def test_exp_and_sigmoid_are_accurate_and_keep_nan() -> None:
    x = np.linspace(-20, 20, 16 * 4000).astype(np.float32)
    x[:3] = np.nan, np.inf, -np.inf

    def body(out, a):  # type: ignore[no-untyped-def]
        for i in range(0, a.size, 16):
            v.store(out, i, v.exp(v.load(a, i)))
            v.store(out, i + a.size, v.sigmoid(v.load(a, i)))

    exp, sigmoid = run(body, x, size=2 * x.size).reshape(2, -1)
    exact = np.exp(x[3:].astype(np.float64))
    np.testing.assert_allclose(exp[3:], exact, rtol=1.2e-6)
    np.testing.assert_allclose(sigmoid[3:], exact / (1 + exact), rtol=1.2e-6)
    assert np.isnan(exp[0]) and exp[1] == np.inf and exp[2] < 2e-38, "what is not finite stays so"
    assert np.isnan(sigmoid[0]) and sigmoid[1] == 1 and sigmoid[2] < 2e-38
