"""Descriptor matching: against bit-by-bit references, one to one, and never out of the radius."""

import numpy as np
import pytest

from pipelines.frontend.matching import hamming_distance, match_all, match_in_radius


def random_descriptors(n, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (n, 32)).astype(np.uint8)


def flip_bits(descriptors, n_bits, seed=1):
    """Copies that differ in exactly `n_bits` bits."""
    rng = np.random.default_rng(seed)
    bits = np.unpackbits(descriptors, axis=1)
    for row in bits:
        row[rng.choice(256, n_bits, replace=False)] ^= 1
    return np.packbits(bits, axis=1)


def reference_distance(a, b):
    return (np.unpackbits(a, axis=1) != np.unpackbits(b, axis=1)).sum(1)


def test_hamming_distance_bit_by_bit():
    a, b = random_descriptors(40, 0), random_descriptors(40, 1)
    found = hamming_distance(a, b)
    np.testing.assert_array_equal(found, reference_distance(a, b))
    assert found.min() > 100 and found.max() < 160
    assert hamming_distance(a, ~a).tolist() == [256] * 40
    assert hamming_distance(a, a).tolist() == [0] * 40
    assert hamming_distance(a[:0], b[:0]).shape == (0,)


def test_hamming_distance_of_strided_descriptors():
    a, b = random_descriptors(20, 2), random_descriptors(20, 3)
    np.testing.assert_array_equal(
        hamming_distance(a[::2], b[::-2]), reference_distance(a[::2], b[::-2])
    )


def scene(n=300, seed=5, shift=3.0, bits=20):
    """Points, and features that are their shuffled copies nearby, with some worn bits."""
    rng = np.random.default_rng(seed)
    uv_a = rng.uniform(0, 400, (n, 2))
    order = rng.permutation(n)
    uv_b = (uv_a + rng.uniform(-shift, shift, (n, 2)))[order]
    a = random_descriptors(n, seed)
    return uv_a, a, uv_b, flip_bits(a, bits)[order], np.argsort(order)


def test_radius_matches_are_the_right_ones():
    uv_a, a, uv_b, b, truth = scene()
    i, j = match_in_radius(uv_a, a, uv_b, b, 10.0, 64)
    assert len(i) == len(uv_a)
    np.testing.assert_array_equal(truth[i], j)


def test_radius_and_distance_limits_are_kept():
    uv_a, a, uv_b, b, _ = scene(shift=12.0, bits=40)
    b[::2] = random_descriptors(len(b[::2]), 9)
    i, j = match_in_radius(uv_a, a, uv_b, b, 8.0, 50)
    assert 20 < len(i) < 140
    assert (np.linalg.norm(uv_a[i] - uv_b[j], axis=1) <= 8.0).all()
    assert (reference_distance(a[i], b[j]) <= 50).all()


def test_radius_matches_are_exactly_the_mutual_nearest():
    """Against all pairs, with many rivals: 24 bits only, so that ties are rare but rivals near."""
    rng = np.random.default_rng(7)
    uv_a, uv_b = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    base = random_descriptors(1, 8)
    a = flip_bits(np.repeat(base, 80, 0), 60, 1)
    b = flip_bits(np.repeat(base, 90, 0), 60, 2)
    near = np.linalg.norm(uv_a[:, None] - uv_b[None], axis=-1) <= 15
    bits = np.array([reference_distance(np.repeat(row[None], 90, 0), b) for row in a])
    bits = np.where(near & (bits <= 110), bits, 999)
    least_of_a, least_of_b = bits.min(1), bits.min(0)
    best = (bits < 999) & (bits == least_of_a[:, None]) & (bits == least_of_b[None])
    unique = best & (best.sum(0) == 1)[None] & (best.sum(1) == 1)[:, None]
    unique &= ((bits == least_of_a[:, None]).sum(1) == 1)[:, None]
    unique &= ((bits == least_of_b[None]).sum(0) == 1)[None]
    i, j = match_in_radius(uv_a, a, uv_b, b, 15.0, 110)
    found = np.zeros_like(best)
    found[i, j] = True
    assert unique.sum() > 10
    assert found[unique].all()
    assert not found[~best].any()


def test_radius_matching_is_one_to_one():
    """Everything looks alike and lies together: still nobody is taken twice."""
    n = 40
    uv = np.random.default_rng(9).uniform(0, 5, (n, 2))
    same = np.repeat(random_descriptors(1), n, 0)
    i, j = match_in_radius(uv, same, uv[::-1], same, 50.0, 64)
    assert len(i) == len(j) >= 1
    assert len(np.unique(i)) == len(i) and len(np.unique(j)) == len(j)


def test_a_feature_exactly_on_its_prediction_is_found():
    uv, a = np.array([[10.0, 20.0], [200.0, 50.0]]), random_descriptors(2)
    i, j = match_in_radius(uv, a, uv, a, 4.0, 0)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (1, 1)]


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_to_match(n, m):
    i, j = match_in_radius(np.zeros((n, 2)), random_descriptors(n), np.zeros((m, 2)),
                           random_descriptors(m), 5.0, 64)  # fmt: skip
    assert len(i) == len(j) == 0
    i, j = match_all(random_descriptors(n), random_descriptors(m), 64, 0.8)
    assert len(i) == len(j) == 0


def test_points_far_from_every_feature_match_nothing():
    a = random_descriptors(3)
    i, j = match_in_radius(np.zeros((3, 2)), a, np.full((3, 2), 100.0), a, 5.0, 256)
    assert len(i) == len(j) == 0


def test_matching_all_finds_the_true_pairs():
    _, a, _, b, truth = scene(n=200, bits=30)
    strangers = random_descriptors(80, 77)
    i, j = match_all(np.vstack([a, strangers]), b, 64, 0.8)
    assert len(i) == 200
    np.testing.assert_array_equal(truth[i], j)


def test_matching_all_refuses_doubles_and_strangers():
    """Lowe's test: where two candidates are equally near, neither is believed."""
    a = random_descriptors(50)
    twins = np.vstack([flip_bits(a[:25], 20, 3), flip_bits(a[:25], 20, 4), a[25:]])
    i, j = match_all(a, twins, 64, 0.8)
    assert (i >= 25).all() and len(i) == 25
    np.testing.assert_array_equal(i + 25, j)
    assert len(match_all(a, random_descriptors(60, 5), 64, 0.99)[0]) == 0


def test_matching_all_is_one_to_one():
    base = random_descriptors(30)
    crowded = np.vstack([flip_bits(base, 5, k) for k in range(3)])
    i, j = match_all(crowded, base, 64, 0.8)
    assert len(np.unique(i)) == len(i) == len(np.unique(j)) == len(j) == 30
