# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from manyeyes.ops.raycast import HeightField
from manyeyes.simulator.scene.ground import ASPHALT, CROSSING, GRASS, PAINT, SIDEWALK
from manyeyes.simulator.sensors.fractal_noise import fractal_noise
from manyeyes.simulator.sensors.materials import FACADE, PAINTWORK, STEEL
from manyeyes.simulator.sensors.texture import SolidPoints, ground_cover, ground_rgb, smoothstep, solid_rgb


def field(surface: np.ndarray) -> HeightField:
    return HeightField(np.zeros((3, 3), np.float32), surface.astype(np.uint8), 0.0, 0.0, 50.0, 0.125)


def here(count: int, low: float = 1.0, high: float = 20.0) -> np.ndarray:
    return np.random.default_rng(3).uniform(low, high, (count, 2))


def across(width: float, count: int) -> np.ndarray:
    return np.tile([width, 0.0], (count, 1))


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.5, 1.0])
def test_a_line_one_cell_wide_has_no_gaps_in_any_direction(slope: float) -> None:
    rows, columns = np.mgrid[0:220, 0:160]
    middle = 40 + slope * (columns + 0.5)
    surface = np.where(np.abs(rows + 0.5 - middle) <= 0.5 * np.hypot(1, slope), PAINT, ASPHALT)
    x = np.linspace(2, 18, 3000)
    along = np.stack((x, (40 + slope * x / 0.125) * 0.125), -1)
    paint = ground_cover(field(surface), along, across(0.01, 3000)).paint
    assert paint.min() > 0.6
    beside = ground_cover(field(surface), along + (0.0, 0.4), across(0.01, 3000)).paint
    assert beside.max() == 0


def test_cover_is_the_share_of_cells_in_a_long_pixel() -> None:
    columns = np.mgrid[0:160, 0:160][1]
    stripes = np.where(columns // 4 % 2 == 0, CROSSING, ASPHALT)  # half a metre, half a metre
    cover = ground_cover(field(stripes), here(2000, 8, 12), across(7.0, 2000))
    assert abs(cover.paint.mean() - 0.5) < 0.02
    assert cover.paint.std() < 0.2
    assert cover.grass.max() == cover.walk.max() == 0
    outside = ground_cover(field(stripes), -here(5), across(0.01, 5))
    assert outside.grass == pytest.approx(1)


def test_worn_paint_is_darker_than_fresh_and_both_are_brighter_than_the_road() -> None:
    at, pixel = here(4000, 2, 18), across(0.01, 4000)
    painted, bare = (field(np.full((160, 160), kind)) for kind in (PAINT, ASPHALT))
    fresh, worn = (ground_rgb(painted, at, pixel, wear, 3).mean() for wear in (0.05, 0.95))
    road = ground_rgb(bare, at, pixel, 0.5, 3).mean()
    assert fresh > 1.2 * worn > 1.5 * road
    green = ground_rgb(field(np.full((160, 160), GRASS)), at, pixel, 0.5, 3).mean(0)
    assert green.argmax() == 1
    walk = ground_rgb(field(np.full((160, 160), SIDEWALK)), at, pixel, 0.5, 3).mean()
    assert road < walk < fresh


def spots(count: int) -> SolidPoints:
    random = np.random.default_rng(4)
    half = random.uniform(0.3, 6, (count, 3))
    axis = random.integers(3, size=count)
    local = random.uniform(-1, 1, (count, 3)) * half
    side = random.choice([-1.0, 1.0], count)
    local[np.arange(count), axis] = (half[np.arange(count), axis]) * side
    real = [
        local, side, half, random.uniform(0.001, 0.4, count), random.uniform(0, 0.8, (count, 3)), random.random(count),
        np.stack((0 * half[:, 0], 0 * half[:, 1], half[:, 2]), -1), 2 * half,
        np.stack((0.3 * half[:, 0], -0.3 * half[:, 0], np.full(count, np.inf), 0.2 * half[:, 2]), -1),
    ]  # fmt: skip
    real = [value.astype(np.float32) for value in real]
    return SolidPoints(real[0], axis, *real[1:])


@pytest.mark.parametrize("material", range(FACADE, STEEL + 1))
def test_albedo_and_gloss_are_shares(material: int) -> None:
    albedo, gloss = solid_rgb(material, spots(3000), 7)
    assert albedo.shape == (3000, 3)
    assert albedo.dtype == gloss.dtype == np.float32
    assert np.isfinite(albedo).all()
    assert albedo.min() >= 0
    assert albedo.max() < 1.7  # a crown's brightest leaves
    assert 0 <= gloss.min() <= gloss.max() <= 1


def test_wheels_are_dark_and_flanks_have_the_lacquers_colour() -> None:
    count = 400
    x = np.linspace(-2.2, 2.2, count).astype(np.float32)
    one, zero = np.ones(count, np.float32), np.zeros(count, np.float32)
    flank = SolidPoints(
        np.stack((x, 0.9 * one, -0.2 * one), -1), np.ones(count, np.int64), one,
        np.tile(np.float32([2.2, 0.9, 0.3]), (count, 1)), 0.005 * one, np.tile(np.float32([0.4, 0.03, 0.03]), (count, 1)),
        0.3 * one, np.stack((zero, zero, 0.6 * one), -1), np.tile(np.float32([4.4, 1.8, 1.5]), (count, 1)),
        np.tile(np.float32([1.36, -1.28, np.inf, 0.32]), (count, 1)),
    )  # fmt: skip
    albedo, _ = solid_rgb(PAINTWORK, flank, 7)
    tyre = np.abs(np.abs(x - 1.36) - 0.26) < 0.03
    free = (np.abs(x) < 0.6) & (albedo[:, 0] > 0.2)
    assert albedo[tyre].max() < 0.1
    assert free.mean() > 0.2
    assert (albedo[free, 0] > 4 * albedo[free, 1]).all()


def test_noise_is_centred_smooth_and_shifted_by_its_seed() -> None:
    at = here(20_000, -80, 80)
    one, two = fractal_noise(at, 1.0, 1), fractal_noise(at, 1.0, 2)
    assert abs(one.mean()) < 0.05
    assert abs(one.std() - 1) < 0.1
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.1
    assert np.abs(fractal_noise(at + 1e-4, 1.0, 1) - one).max() < 0.02
    np.testing.assert_allclose(fractal_noise(at + (16.0, 0.0), 1.0, 1), one, atol=1e-4)


def test_smooth_goes_from_nought_to_one() -> None:
    assert smoothstep(1.0, 3.0, np.array([0.0, 1.0, 2.0, 3.0, 9.0])).tolist() == [0, 0, 0.5, 1, 1]


@pytest.mark.parametrize(
    ("size", "height", "low", "high"), [((8.0, 2.4, 3.2), 1.3, 0.46, 0.68), ((5.4, 2.0, 2.4), 1.9, 0.52, 0.86)]
)
def test_windscreens_of_lorries_and_vans_lie_between_two_heights(size, height, low, high) -> None:
    """A column of points in the middle of a lorry's front, and one through the side window of a van."""
    count = 500
    z, one = np.linspace(0.5, 0.98 * size[2], count).astype(np.float32), np.ones(count, np.float32)
    lorry = size[0] > 6
    local = np.stack(
        (0.5 * size[0] * one, 0.5 * one, z) if lorry else (0.2 * size[0] * one, 0.5 * size[1] * one, z), -1
    )
    spots = SolidPoints(
        local, np.full(count, int(not lorry)), one, np.tile(np.float32([size[0] / 2, size[1] / 2, height]), (count, 1)),
        0.005 * one, np.tile(np.float32([0.6, 0.6, 0.6]), (count, 1)), 0.3 * one, np.zeros((count, 3), np.float32),
        np.tile(np.float32(size), (count, 1)), np.tile(np.float32([9.0, 9.0, np.inf, 0.3]), (count, 1)),
    )  # fmt: skip
    albedo, gloss = solid_rgb(PAINTWORK, spots, 7)
    glass = z[(albedo.max(1) < 0.1) & (gloss > 0.95) & (z > 0.4 * size[2])]
    assert glass.min() == pytest.approx(low * size[2], abs=0.03)
    assert glass.max() == pytest.approx(high * size[2], abs=0.03)
