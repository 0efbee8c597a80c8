"""Features spread over the image, and mutual matches."""

import numpy as np

from barsight.core.arrays import UInt8
from barsight.features.matching import match_mutual
from barsight.features.orb import Features, describe_upright, detect_orb
from synthetic_scenes import Texture, quantised


def shifted(dx: float, dy: float, noise: float = 0.0) -> UInt8:
    """The same texture moved by (dx, dy) px to the right and down."""
    u, v = np.meshgrid(np.arange(320.0) - dx, np.arange(240.0) - dy)
    return quantised(Texture(3)(u, v) + np.random.default_rng(0).normal(0, noise or 1e-9, u.shape))


def test_features_are_spread_over_the_cells() -> None:
    """A label of much stronger contrast doesn't take them all."""
    image = (128 + (shifted(0, 0).astype(float) - 128) * 0.3).astype(np.uint8)
    label = np.random.default_rng(1).integers(0, 2, (10, 10), dtype=np.uint8) * 255
    image[60:120, 60:120] = label.repeat(6, 0).repeat(6, 1)
    found = detect_orb(image, 480, cells=(6, 8))
    assert 240 < len(found) <= 480
    row, column = (found.pixels[:, 1] // 40).astype(int), (found.pixels[:, 0] // 40).astype(int)
    counts = np.bincount(row * 8 + column, minlength=48).reshape(6, 8)
    assert counts.max() <= 10
    assert (counts[1:-1, 1:-1] >= 5).all()


def test_an_empty_image_has_no_features() -> None:
    found = detect_orb(np.full((240, 320), 90, np.uint8), 500)
    assert len(found) == 0
    assert found.descriptors.shape == (0, 32)
    assert match_mutual(found, found).shape == (0, 2)


def test_matches_are_mutual() -> None:
    first, second = detect_orb(shifted(0, 0), 600), detect_orb(shifted(7, -4), 600)
    pairs = match_mutual(first, second)
    assert len(pairs) > 100
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    moved = second.pixels[pairs[:, 1]] - first.pixels[pairs[:, 0]]
    assert (np.linalg.norm(moved - (7, -4), axis=1) < 3).mean() > 0.95


def test_places_described_upright_are_told_apart() -> None:
    """Each is its own nearest in the moved picture, to a pixel at half size; those at the border leave."""
    places = np.stack(np.meshgrid(np.arange(70.0, 250, 14), np.arange(70.0, 170, 14)), -1).reshape(-1, 2)
    places = np.vstack([places, [[5.0, 120.0]]]).astype(np.float32)
    first = describe_upright(shifted(0, 0), places)
    second = describe_upright(shifted(7, -4, noise=2.0), places + np.array([8, -4], np.float32))
    np.testing.assert_array_equal(first.pixels, places[:-1])
    pairs = match_mutual(first, second)
    assert (pairs[:, 0] == pairs[:, 1]).all()
    assert len(pairs) > 0.95 * len(first)
    assert len(describe_upright(shifted(0, 0), places[-1:])) == 0


def test_mutual_matching_is_brute_force() -> None:
    rng = np.random.default_rng(2)
    descriptors = rng.integers(0, 256, (40, 32), dtype=np.uint8)
    flips = (rng.random((40, 32, 8)) < 0.05).astype(np.uint8)
    noisy = descriptors ^ np.packbits(flips, axis=2)[..., 0]
    noisy = np.vstack([noisy[::-1][:30], noisy[15:17]])  # 10 left out; two stand twice
    places = np.zeros((40, 2), np.float32)
    pairs = match_mutual(
        Features(places, descriptors, places[:, 0]), Features(places[:32], noisy, places[:32, 0])
    )
    distance = np.unpackbits(descriptors[:, None] ^ noisy[None], axis=2).sum(axis=2)
    expected = []
    for i in range(40):
        j, second = np.argsort(distance[i], kind="stable")[:2]
        if distance[:, j].argmin() == i and distance[i, j] < 0.9 * distance[i, second]:
            expected.append((i, int(j)))
    assert [tuple(pair) for pair in pairs.tolist()] == expected
    assert len(expected) == 28
