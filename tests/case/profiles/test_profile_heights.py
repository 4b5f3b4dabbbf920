"""Heights of profiles: closed forms, derivatives, jumps, contact patch, known and traced."""

import json

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.signal.windows import hann

import jaxbeam as jb
from jaxbeam.case.fields import kinds
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.profiles.spectra import DIRECT_SIZE, RAIL_SPECTRA, ROAD_CLASSES, sum_of_cosines
from tests.differences import central
from tests.modules import DATA

# One profile of every kind, with and without a contact patch.

POSITIONS = [-3.0, -1.0, 0.5, 1.0, 2.5, 4.0, 7.0]
HEIGHTS = [0.0, 2e-3, -1e-3, 1e-3, 4e-3, 3e-3, 5e-3]

# The waves of random profiles are few, so that tests are quick.
PLAIN = {
    "table": jb.profiles.TableProfile(POSITIONS, HEIGHTS),
    "sine": jb.profiles.SineProfile(amplitude=5e-3, wavelength=3.0, phase=0.4),
    "ramp": jb.profiles.RampProfile(start=1.0, end=3.0, height=0.01),
    "step": jb.profiles.StepProfile(start=1.0, end=3.0, height=-0.01),
    "bump": jb.profiles.BumpProfile(start=1.0, end=3.0, height=0.02),
    "spectrum": jb.profiles.SpectrumProfile([0.1, 0.35, 1.2], [4e-3, 2e-3, 1e-4], [0.3, 2.0, 5.0]),
    "iso8608": jb.profiles.ISO8608Profile("C", seed=4, waves=12, switch_on=[-2.0, 3.0]),
    "rail": jb.profiles.RailProfile("fra-3", seed=2, waves=12, switch_on=[6.0, 1.0]),
}
AVERAGED = {
    "table": jb.profiles.TableProfile(POSITIONS, HEIGHTS, contact_length=0.7),
    "sine": jb.profiles.SineProfile(5e-3, 3.0, 0.4, contact_length=0.7),
    "ramp": jb.profiles.RampProfile(1.0, 3.0, 0.01, contact_length=0.7),
    "step": jb.profiles.StepProfile(1.0, 3.0, -0.01, contact_length=0.7),
    "bump": jb.profiles.BumpProfile(1.0, 3.0, 0.02, contact_length=0.7),
    "spectrum": jb.profiles.SpectrumProfile(
        [0.1, 0.35, 1.2], [4e-3, 2e-3, 1e-4], [0.3, 2.0, 5.0], contact_length=0.7
    ),
    "iso8608": jb.profiles.ISO8608Profile(
        "C", 4, waves=12, switch_on=[-2.0, 3.0], contact_length=0.7
    ),
    "rail": jb.profiles.RailProfile("fra-3", 2, waves=12, switch_on=[6.0, 1.0], contact_length=0.7),
}
PROFILES = PLAIN | {f"{kind}, contact patch": profile for kind, profile in AVERAGED.items()}


X = np.linspace(-5.0, 9.0, 57) + 0.0123  # away from all jumps and edges of a patch
EVERY = pytest.mark.parametrize("name", PROFILES)


def test_examples_have_every_kind():
    assert set(PLAIN) == set(AVERAGED) == set(kinds(AbstractProfile))


@EVERY
def test_derivatives_are_those_of_the_height(name):
    profile = PROFILES[name]
    _, slope, curvature = profile.heights(X)
    step = 1e-3
    for order, derivative in ((0, slope), (1, curvature)):
        offsets, weights = [-3, -2, -1, 1, 2, 3], [-1 / 60, 3 / 20, -3 / 4, 3 / 4, -3 / 20, 1 / 60]
        values = [profile.heights(X + n * step)[order] for n in offsets]
        difference = np.tensordot(weights, values, 1) / step
        assert_allclose(derivative, difference, atol=1e-8 * np.abs(derivative).max() + 1e-12)


@EVERY
def test_known_and_traced_numbers_give_the_same(name):
    profile = PROFILES[name]
    known = np.stack(profile.heights(X))
    assert isinstance(known, np.ndarray)
    assert isinstance(profile.kinks(), np.ndarray)
    traced = eqx.filter_jit(lambda profile, x: (profile.heights(x), profile.kinks()))
    moved = jax.tree.map(jax.numpy.asarray, profile)
    heights, kinks = traced(moved, X)
    assert_allclose(heights, known, rtol=1e-11, atol=1e-13)
    assert_array_equal(kinks, profile.kinks())
    assert_allclose(traced(profile, jax.numpy.asarray(X))[0], known, rtol=1e-11, atol=1e-13)


@EVERY
def test_positions_of_any_shape(name):
    profile = PROFILES[name]
    flat = profile.heights(X[:12])
    for got, expected in zip(profile.heights(X[:12].reshape(2, 3, 2)), flat, strict=True):
        assert_allclose(got, expected.reshape(2, 3, 2), rtol=1e-13, atol=1e-16)
    for got, expected in zip(profile.heights(float(X[4])), flat, strict=True):
        assert np.shape(got) == ()
        assert_allclose(got, expected[4], rtol=1e-13, atol=1e-16)


@EVERY
def test_slope_and_curvature_jump_at_kinks_only(name):
    """At kinks the slope jumps, or else the curvature; nowhere else, and the height never."""
    profile, side = PROFILES[name], 1e-8
    edges = [0.0, *POSITIONS, 1.0, 3.0, 6.0, -2.0]
    edges = np.unique([e + d for e in edges for d in (-0.35, 0.0, 0.35)])
    kinks = np.asarray(profile.kinks())
    scales = [np.abs(part).max() or 1.0 for part in profile.heights(np.linspace(-5, 9, 999))]

    def jumps(x):
        pairs = zip(profile.heights(x + side), profile.heights(x - side), scales, strict=True)
        return np.array([np.abs(a - b) / scale for a, b, scale in pairs])

    smooth = np.array([x for x in edges if not np.isclose(x, kinks).any()])
    assert jumps(smooth).max() < 1e-6
    if kinks.size:
        height, slope, curvature = jumps(kinks)
        assert height.max() < 1e-6
        assert (np.maximum(slope, curvature) > 1e-2).all()
    places, sizes = profile.slope_kinks()
    assert places.size == (np.sum(slope > 1e-2) if kinks.size else 0)
    for x, size in zip(places, sizes, strict=True):
        right, left = (profile.heights(x + s)[1] for s in (side, -side))
        assert_allclose(size, right - left, rtol=1e-6)


def test_only_a_ramp_without_a_contact_patch_has_jumps_of_slope():
    assert [name for name, profile in PROFILES.items() if profile.slope_kinks()[0].size] == ["ramp"]
    assert_allclose(PROFILES["ramp"].kinks(), [1.0, 3.0])
    assert_allclose(np.sort(AVERAGED["ramp"].kinks()), [0.65, 1.35, 2.65, 3.35])
    assert_allclose(PROFILES["bump"].kinks(), [1.0, 3.0])
    assert_allclose(PROFILES["table"].kinks(), [-3.0, 7.0])
    assert not AVERAGED["bump"].kinks().size and not AVERAGED["table"].kinks().size


@pytest.mark.parametrize("kind", PLAIN)
def test_a_contact_patch_feels_the_mean_of_the_surface(kind):
    """Against numerical integration; where a profile is switched on, the switch is a factor."""
    plain, averaged = PLAIN[kind], AVERAGED[kind]
    x = np.array([-2.9, -0.4, 0.8, 1.1, 2.0, 2.9, 3.3, 6.9])
    if kind in ("iso8608", "rail"):
        plain = eqx.tree_at(lambda p: p.switch_on, plain, np.array([-99.0, -98.0]))
        averaged = eqx.tree_at(lambda p: p.switch_on, averaged, np.array([-99.0, -98.0]))
    breaks = [*POSITIONS, 1.0, 3.0]
    mean = [
        quad(
            lambda s: float(plain.heights(s)[0]),
            centre - 0.35,
            centre + 0.35,
            points=[b for b in breaks if abs(b - centre) < 0.35],
            epsabs=1e-14,
        )[0]
        / 0.7
        for centre in x
    ]
    scale = np.abs(mean).max()
    assert_allclose(averaged.heights(x)[0], mean, rtol=1e-9, atol=1e-11 * scale)


def test_sine():
    profile = jb.profiles.SineProfile(amplitude=0.005, wavelength=5.0)
    height, slope, curvature = profile.heights(np.array([0.0, 1.25, 2.5, -1.25]))
    assert_allclose(height, [0.0, 0.005, 0.0, -0.005], atol=1e-17)
    assert_allclose(slope, 0.002 * np.pi * np.array([1.0, 0.0, -1.0, 0.0]), atol=1e-17)
    assert_allclose(curvature, 0.005 * (0.4 * np.pi) ** 2 * np.array([0, -1, 0, 1]), atol=1e-16)


def test_ramp():
    profile = jb.profiles.RampProfile(5.0, 7.0, 0.01)
    height, slope, curvature = profile.heights(np.array([4.0, 5.0, 5.5, 7.0, 90.0]))
    assert_allclose(height, [0.0, 0.0, 0.0025, 0.01, 0.01])
    assert_allclose(slope, [0.0, 0.005, 0.005, 0.0, 0.0])
    assert_allclose(curvature, 0.0)


def test_step_is_the_quintic_with_level_ends():
    """Of six conditions: height, slope and curvature at both ends."""
    rows = [[1, a, a**2, a**3, a**4, a**5] for a in (2.0, 6.0)]
    rows += [[0, 1, 2 * a, 3 * a**2, 4 * a**3, 5 * a**4] for a in (2.0, 6.0)]
    rows += [[0, 0, 2, 6 * a, 12 * a**2, 20 * a**3] for a in (2.0, 6.0)]
    quintic = np.polynomial.Polynomial(np.linalg.solve(rows, [0, 0.3, 0, 0, 0, 0]))
    x = np.linspace(2.0, 6.0, 9)
    profile = jb.profiles.StepProfile(2.0, 6.0, 0.3)
    for order, part in enumerate(profile.heights(x)):
        assert_allclose(part, quintic.deriv(order)(x), atol=1e-12)
    assert_allclose(np.stack(profile.heights(np.array([-1.0, 8.0]))), [[0, 0.3], [0, 0], [0, 0]])


def test_bump():
    profile = jb.profiles.BumpProfile(-8.0, -6.0, 0.02)
    height, slope, curvature = profile.heights(np.array([-9.0, -8.0, -7.5, -7.0, -6.0, 0.0]))
    assert_allclose(height, [0.0, 0.0, 0.01, 0.02, 0.0, 0.0], atol=1e-17)
    assert_allclose(slope, [0.0, 0.0, 0.01 * np.pi, 0.0, 0.0, 0.0], atol=1e-17)
    assert_allclose(curvature, 0.01 * np.pi**2 * np.array([0, 1, 0, -1, 0, 0]), atol=1e-16)


def test_table_is_the_spline_with_level_ends():
    spline = CubicSpline(POSITIONS, HEIGHTS, bc_type="clamped")
    x = np.linspace(-3.0, 7.0, 101)[:-1]
    for order, part in enumerate(PLAIN["table"].heights(x)):
        assert_allclose(part, spline(x, order), rtol=1e-12, atol=1e-16)
    beyond = np.stack(PLAIN["table"].heights(np.array([-40.0, 7.0, 50.0])))
    assert_allclose(beyond, [[0.0, 5e-3, 5e-3], [0, 0, 0], [0, 0, 0]], atol=1e-17)
    height, slope, curvature = jb.profiles.TableProfile([0.0, 2.0], [0.0, 1.0]).heights(1.0)
    assert_allclose([height, slope, curvature], [0.5, 0.75, 0.0])  # level at both ends


NUMBERS = [
    (name, field)
    for name, profile in PROFILES.items()
    for field, value in vars(profile).items()
    if isinstance(value, np.ndarray)
]


@pytest.mark.parametrize(("name", "field"), NUMBERS)
def test_gradients_are_those_of_differences(name, field):
    """With respect to every number of every kind."""
    profile = PROFILES[name]
    value = np.asarray(getattr(profile, field), float)
    if field == "positions":  # the end of a table is where a wheel of these positions has passed
        x = np.array([-2.1, 0.2, 0.9, 3.3])
    else:
        x = np.array([-2.7, 1.2, 2.1, 2.8, 5.4])

    def heights(number):
        changed = eqx.tree_at(lambda p: getattr(p, field), profile, number)
        return changed.heights(x)

    derivative = jax.jit(jax.jacfwd(lambda number: jax.numpy.stack(heights(number))))(value)
    backward = jax.jit(jax.jacrev(lambda number: jax.numpy.stack(heights(number))))(value)
    step = 1e-4 * max(1e-2, np.abs(value).max())
    differences = central(lambda p: np.stack(heights(p.reshape(value.shape))), value.ravel(), step)
    differences = differences.reshape(np.shape(derivative))
    scale = np.abs(differences).reshape(3, -1).max(axis=1).reshape(3, *[1] * (differences.ndim - 1))
    assert (np.abs(derivative - differences) <= 1e-7 * scale + 1e-12).all()
    assert_allclose(backward, derivative, rtol=1e-9, atol=1e-12 * scale.max())


def test_gradient_of_the_position_of_a_wheel():
    """Of a wheel that moves over the surface: what the integrator differentiates."""
    for profile in PROFILES.values():
        x = np.array([-1.7, 1.2, 2.1, 4.4])
        height, slope, curvature = profile.heights(x)
        for i, expected in ((0, slope), (1, curvature)):
            got = jax.jacfwd(lambda x, i=i, p=profile: p.heights(x)[i])(x)
            scale = np.abs(expected).max()
            assert_allclose(np.diag(got), expected, rtol=1e-9, atol=1e-12 * scale)


# Random profiles: published densities, spectrum of a realisation, seeds, switching on.

REFERENCE = json.loads((DATA / "profiles.json").read_text())
EVERYWHERE = [-1e4, -0.9e4]  # switched on long before
RANDOM = [jb.profiles.ISO8608Profile("B", 1, switch_on=EVERYWHERE)] + [
    jb.profiles.RailProfile(name, 1, switch_on=EVERYWHERE) for name in RAIL_SPECTRA
]
REALISATIONS = pytest.mark.parametrize("profile", RANDOM, ids=["B", *RAIL_SPECTRA])


@pytest.mark.parametrize("name", REFERENCE)
def test_reference_profiles(name):
    """The table of the reference has eight digits."""
    given = REFERENCE[name]
    start, length = given["switch_on"]["x0"], given["switch_on"]["length"]
    profile = jb.profiles.SpectrumProfile(
        given["n"], given["amp"], given["phase"], switch_on=[start, start + length]
    )
    table = np.array(given["table_r_every_5th"])
    x = given["table_x0"] + given["table_dx"] * np.arange(table.size)
    assert_allclose(profile.heights(x)[0], table, atol=6e-11)
    assert_allclose(np.stack(profile.heights(np.array([-60.0, -40.0]))), 0.0, atol=0)


@pytest.mark.parametrize(
    ("name", "profile"),
    [("iso8608-A", jb.profiles.ISO8608Profile("A")), ("fra-6", jb.profiles.RailProfile("fra-6"))],
)
def test_densities_give_the_amplitudes_of_the_reference(name, profile):
    given = REFERENCE[name]
    n = np.array(given["n"])
    assert_allclose(np.sqrt(2 * profile.density(n) * (n[1] - n[0])), given["amp"], rtol=1e-7)


def test_classes_of_iso_8608():
    """Geometric means of ISO 8608:2016, table C.1, at 0.1 cycles per metre, in 1e-6 m^3."""
    means = [16, 64, 256, 1024, 4096, 16384, 65536, 262144]
    for name, mean in zip(ROAD_CLASSES, means, strict=True):
        assert_allclose(
            jb.profiles.ISO8608Profile(name).density(np.array([0.1, 1.0])),
            [mean * 1e-6] * 2 * np.array([1.0, 0.01]),
        )


def test_rail_spectra_by_hand():
    """S(n) in m^3: at the corner of the French spectrum, far above and far below the others'."""
    french = RAIL_SPECTRA["sncf-poor"].density(0.0489)
    assert_allclose(french, 1.79 * 308e-6 / 8)
    german = RAIL_SPECTRA["german-high"].density(0.8246 / (2 * np.pi))
    assert_allclose(german, 2 * np.pi * 1.08e-6 / (2 * 0.8246**2), rtol=7e-4)
    american = RAIL_SPECTRA["fra-1"].density(np.array([1e-4, 100.0]))
    assert_allclose(american, 15.53e-8 * np.array([0.0233**2 / 1e-16, 0.131**2 / 1e8]), rtol=3e-5)


def test_wavelengths_of_rail_spectra():
    """In m, as in the options of TTB-2D (`A04_Options.m`)."""
    published = {"fra-3": (1.524, 304.8), "german-low": (3.0, 150.0), "sncf-poor": (2.0, 40.0)}
    for name, wavelengths in published.items():
        lowest, highest = jb.profiles.RailProfile(name).wavenumber_range()
        assert_allclose((1 / highest, 1 / lowest), wavelengths, rtol=1e-12)


@pytest.mark.parametrize("name", ["german-low", "german-high"])
def test_density_by_wavenumber_has_the_variance_of_that_by_radians(name):
    """Integral of S(Omega), in closed form, over all wavelengths."""
    a = {"german-low": 4.032e-7, "german-high": 1.080e-6}[name]
    c, r = 0.8246, 0.0206
    density = RAIL_SPECTRA[name].density
    low, high = 0.01, 3.0  # rad/m
    shape = (np.arctan(high / r) - np.arctan(low / r)) / r
    shape -= (np.arctan(high / c) - np.arctan(low / c)) / c
    exact = a * c**2 / (c**2 - r**2) * shape
    assert_allclose(quad(density, low / (2 * np.pi), high / (2 * np.pi))[0], exact, rtol=1e-9)


@REALISATIONS
def test_variance_is_the_integral_of_the_density(profile):
    lowest, highest = map(float, profile.wavenumber_range())
    exact = quad(profile.density, lowest, highest, epsrel=1e-10, limit=200)[0]
    _, amplitudes, _ = profile.lines()
    assert_allclose(np.sum(amplitudes**2) / 2, exact, rtol=1e-3)


def test_variance_of_a_road_is_exact():
    """S ~ n^-2: its integral is S(n0) n0^2 (1 / lowest - 1 / highest), whatever the waves."""
    for waves in (5, 200):
        profile = jb.profiles.ISO8608Profile(
            "A", 3, lowest_wavenumber=0.02, highest_wavenumber=2.0, waves=waves
        )
        _, amplitudes, _ = profile.lines()
        assert_allclose(np.sum(amplitudes**2) / 2, 16e-6 * 0.01 * (1 / 0.02 - 1 / 2), rtol=1e-12)


@REALISATIONS
def test_periodogram_of_a_realisation(profile):
    """Power of five bands of a road or track so long that its waves do not interfere."""
    lowest, highest = map(float, profile.wavenumber_range())
    step, size = 0.4 / highest, 200_000
    x = step * np.arange(size)
    height = np.concatenate([profile.heights(part)[0] for part in np.split(x, 20)])
    window = hann(size, sym=False)
    power = np.abs(np.fft.rfft(window * height)) ** 2 * 2 * step / np.sum(window**2)
    n = np.fft.rfftfreq(size, step)
    assert_allclose(
        np.sum(power) * n[1], quad(profile.density, lowest, highest, limit=200)[0], rtol=0.02
    )
    edges = np.geomspace(lowest, highest, profile.waves + 1)[:: profile.waves // 5]
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        band = np.sum(power[(n >= low) & (n < high)]) * n[1]
        assert_allclose(band, quad(profile.density, low, high, limit=200)[0], rtol=0.05)


def test_a_seed_is_a_profile():
    x = np.linspace(0.0, 40.0, 60)
    first, again = (jb.profiles.ISO8608Profile("A", seed=7).heights(x) for _ in range(2))
    assert_array_equal(first, again)
    assert_allclose(jb.profiles.ISO8608Profile("B", seed=7).heights(x)[0], 2 * first[0], atol=1e-15)
    scaled = jb.profiles.ISO8608Profile("A", seed=7, scale=3.0).heights(x)[0]
    assert_allclose(scaled, 3 * first[0], atol=1e-15)
    other = jb.profiles.ISO8608Profile("A", seed=8).heights(x)[0]
    assert abs(np.corrcoef(other, first[0])[0, 1]) < 0.9
    phases = jb.profiles.RailProfile("fra-2", seed=7).lines()[2]
    assert_array_equal(phases, np.random.default_rng(7).uniform(0, 2 * np.pi, 100))


def test_heights_are_normally_distributed_over_seeds():
    """Kurtosis 3, no correlation between seeds."""
    x = np.array([12.0])
    profiles = [jb.profiles.ISO8608Profile("A", seed) for seed in range(2000)]
    heights = np.array([profile.heights(x)[0][0] for profile in profiles])
    deviation = np.sqrt(16e-6 * 0.01 * (1 / 0.01 - 1 / 4.0))
    assert_allclose(heights.std(), deviation, rtol=0.05)
    assert abs(heights.mean()) < 0.07 * deviation
    assert abs(np.mean(heights**4) / np.mean(heights**2) ** 2 - 3) < 0.3


@pytest.mark.parametrize("switch_on", [[2.0, 8.0], [8.0, 2.0]])
def test_switching_on(switch_on):
    """Zero before, all there behind, half in the middle; also for loads that travel left."""
    profile = jb.profiles.RailProfile("fra-6", 3, switch_on=switch_on)
    full = jb.profiles.RailProfile("fra-6", 3, switch_on=EVERYWHERE)
    before, behind = np.array([[-30.0, 1.9], [8.1, 40.0]])[:: 1 if switch_on[0] < 5 else -1]
    assert_array_equal(np.stack(profile.heights(before)), 0.0)
    assert_array_equal(np.stack(profile.heights(behind)), np.stack(full.heights(behind)))
    middle = profile.heights(np.array([5.0]))[0]
    assert_allclose(middle, full.heights(np.array([5.0]))[0] / 2)


def test_many_waves_are_summed_by_blocks():
    """Equal to the sum at once, derivatives too, for known and for traced numbers."""
    rng = np.random.default_rng(1)
    waves = rng.uniform(0.1, 2.0, 90), rng.normal(size=90), rng.uniform(0, 6, 90)
    x = np.linspace(0.0, 50.0, 2 * DIRECT_SIZE // 90)
    known = sum_of_cosines(x, *waves)
    at_once = [sum_of_cosines(part, *waves) for part in np.array_split(x, 3)]
    assert_allclose(known, np.concatenate(at_once, axis=1), rtol=1e-9, atol=1e-10)
    traced = jax.jit(sum_of_cosines)(x, *waves)
    assert_allclose(traced, known, rtol=1e-9, atol=1e-10)

    def total(amplitudes):
        return sum_of_cosines(x, waves[0], amplitudes, waves[2])[0].sum()

    gradient = jax.jit(jax.grad(total))(waves[1])
    angles = 2 * np.pi * np.outer(waves[0], x) + waves[2][:, None]
    assert_allclose(gradient, np.cos(angles).sum(axis=1), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("shape", [(3, 4000), (40, 50, 6)])
def test_sums_at_close_positions_are_interpolated(shape):
    """Equal to the plain sum to rounding, at both ends of the panels too, derivatives too."""
    rng = np.random.default_rng(2)
    n, amplitudes, phases = np.geomspace(0.01, 3.0, 80), rng.normal(size=80), rng.uniform(0, 6, 80)
    x = rng.uniform(-30.0, 40.0, shape)
    angles = 2 * np.pi * n * x[..., None] + phases
    k = 2 * np.pi * n
    parts = np.cos(angles), -k * np.sin(angles), -(k**2) * np.cos(angles)
    for found, part in zip(sum_of_cosines(x, n, amplitudes, phases), parts, strict=True):
        expected = part @ amplitudes
        assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
