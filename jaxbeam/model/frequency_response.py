"""Frequency responses of a rig: beam, supports, actuators, and masses parked on the beam.

With the states z of the rig and s = 2 pi i f,

    (s E - A) z = B u + shapes(y) . force,    y = (C + s C') z + D u.

E is the identity but for the parked masses, eq. (2.30) of the thesis. C' takes accelerations.
"""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Complex, Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import is_known, known
from jaxbeam.case.validation import check
from jaxbeam.model.channels import Pair, check_pairs, column, common_pairs, row
from jaxbeam.model.modal_model import Rig, rig, rig_in_one
from jaxbeam.model.modes import Layout, lay_out
from jaxbeam.runtime.compiling import compiled

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

Parked = Sequence[tuple[Any, Any]]  # position (m) and mass (kg) of each


class FrequencyResponse(eqx.Module):
    """Frequency responses, one column for each pair of an input and an output.

    `values` are complex: output amplitude per input amplitude, with the phase by which the output
    leads, in the `unit` of the pair.
    """

    frequencies: Float[Array, " frequency"]
    values: Complex[Array, "frequency pair"]
    pairs: tuple[Pair, ...] = eqx.field(static=True)
    title: str = eqx.field(static=True, default="")

    @property
    def magnitude(self) -> Float[Array, "frequency pair"]:
        """Amplitude of the output per amplitude of the input, in the unit of the pair."""
        return jnp.abs(self.values)

    @property
    def phase(self) -> Float[Array, "frequency pair"]:
        """Phase by which the output leads the input in degrees, without jumps of a full turn."""
        return jnp.degrees(jnp.unwrap(jnp.angle(self.values), axis=0))

    def of(self, input: str, output: str) -> Complex[Array, " frequency"]:
        """The response of one pair. Raises ValueError if the record does not have it."""
        for i, pair in enumerate(self.pairs):
            if (pair.input, pair.output) == (input, output):
                return self.values[:, i]
        have = ", ".join(map(str, self.pairs))
        raise ValueError(f"there is no response of {output} to {input}; there are {have}")

    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units, all of it real so that every file format takes it."""
        import xarray

        dims = ("frequency", "pair")
        values = np.asarray(self.values)
        return xarray.Dataset(
            {
                "magnitude": (dims, np.asarray(self.magnitude), {"units": "that of the pair"}),
                "phase": (dims, np.asarray(self.phase), {"units": "degree"}),
                "real": (dims, values.real, {"units": "that of the pair"}),
                "imaginary": (dims, values.imag, {"units": "that of the pair"}),
            },
            {
                "frequency": ("frequency", np.asarray(self.frequencies), {"units": "Hz"}),
                "pair": ("pair", [str(pair) for pair in self.pairs]),
                "input": ("pair", [pair.input for pair in self.pairs]),
                "output": ("pair", [pair.output for pair in self.pairs]),
                "unit": ("pair", [pair.unit for pair in self.pairs]),
            },
            {"title": self.title},
        )

    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists and `overwrite` is not set.
        """
        if not overwrite and os.path.exists(path):
            raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
        self.to_xarray().to_netcdf(path, engine="scipy")


def frequency_response(
    case: Case,
    frequencies,
    pairs: Sequence[tuple[str, str]] | None = None,
    parked: Parked = (),
    layout: Layout | None = None,
) -> FrequencyResponse:
    """Frequency responses of a case at `frequencies` (Hz), its loads away.

    `pairs` are (input, output), each in the words of `ports`; those of `common_pairs` if left
    out. `parked` are masses that stand on the beam and move with it: (position in m, mass in kg).
    Exact for the modes that the case keeps. Differentiable in every number of the case and in the
    frequencies. Inside `jit`, give the `layout` found outside by `modes.lay_out(case)`.

    Raises ValueError for a faulty case, negative frequencies, an unknown input or output, or a
    parked mass that is negative or off the beam.
    """
    check(case)
    frequencies, masses = _frequencies(frequencies), _parked(case, parked)
    chosen = check_pairs(case, common_pairs(case) if pairs is None else pairs)
    layout = lay_out(case) if layout is None else layout
    values = _responses(case, layout, frequencies, masses, chosen)
    return FrequencyResponse(frequencies, values, chosen, case.title)


@compiled
def _responses(case: Case, layout: Layout, frequencies, masses, pairs: tuple[Pair, ...]):
    model = rig(case, layout)
    inputs = [column(case, model, pair.source) for pair in pairs]
    pushes = jnp.stack([pushed for pushed, _ in inputs], axis=-1)
    states = _states(model, masses, frequencies, pushes)
    s = 2j * jnp.pi * frequencies
    responses = []
    for i, (pair, (_, command)) in enumerate(zip(pairs, inputs, strict=True)):
        response = _read(row(case, model, pair.output), states[:, :, i], s, command)
        if pair.source != pair.input:  # the input is itself an output of the actuator
            response = response / _read(row(case, model, pair.input), states[:, :, i], s, command)
        responses.append(response)
    return jnp.stack(responses, axis=-1)


def _read(reading, states, s, command):
    place, rate, direct = reading
    return states @ place + s * (states @ rate) + direct @ command


def _states(model: Rig, masses, frequencies, pushes) -> Complex[Array, "frequency state input"]:
    """States of the rig for each column of pushes, at every frequency (Hz)."""
    matrix, inertia = _matrices(model, masses)
    s = 2j * jnp.pi * frequencies[:, None, None]
    return jnp.linalg.solve(s * inertia - matrix, pushes + 0j)


def _matrices(model: Rig, masses):
    """A and E of the rig with masses parked on it: their positions (m), and what they are (kg)."""
    matrix = block_diag(*model.state_matrix)
    positions, kilograms = masses
    shapes = model.shapes(positions, (0,))[0]
    rates = np.arange(1, 2 * model.modes.stiffness.shape[0], 2)
    added = (shapes.T * kilograms) @ shapes
    return matrix, jnp.eye(model.states).at[np.ix_(rates, rates)].add(added)


def receptance(
    case: Case, frequencies, x, y, parked: Parked = (), layout: Layout | None = None
) -> Complex[Array, "..."]:
    """Deflection at x per force at y, in m/N: (frequency, x..., y...).

    Positions x and y are in m and may have any shapes. Unlike `frequency_response` it is
    differentiable in them. The rest is as there, the errors too.
    """
    check(case)
    frequencies, masses = _frequencies(frequencies), _parked(case, parked)
    layout = lay_out(case) if layout is None else layout
    x, y = _on_beam(case, "x", x), _on_beam(case, "y", y)
    return _receptance(case, layout, frequencies, masses, x, y)


@compiled
def _receptance(case: Case, layout: Layout, frequencies, masses, x, y):
    model = rig(case, layout)
    modes = model.modes.stiffness.shape[0]
    pushes = jnp.zeros((model.states, y.size))
    pushes = pushes.at[1 : 2 * modes : 2].set(model.shapes(y.reshape(-1), (0,))[0].T)
    amplitudes = _states(model, masses, frequencies, pushes)[:, : 2 * modes : 2]
    response = model.shapes(x.reshape(-1), (0,))[0] @ amplitudes
    return response.reshape(frequencies.size, *x.shape, *y.shape)


def mobility(
    case: Case, frequencies, x, y, parked: Parked = (), layout: Layout | None = None
) -> Complex[Array, "..."]:
    """Velocity at x per force at y, in m/(N s): H = s x receptance, eq. (2.29) of the thesis."""
    found = receptance(case, frequencies, x, y, parked, layout)
    return _times_s(frequencies, found)


def accelerance(
    case: Case, frequencies, x, y, parked: Parked = (), layout: Layout | None = None
) -> Complex[Array, "..."]:
    """Acceleration at x per force at y, in 1/kg: A = s H = s^2 x receptance."""
    return _times_s(frequencies, mobility(case, frequencies, x, y, parked, layout))


def _times_s(frequencies, response):
    s = 2j * jnp.pi * jnp.asarray(frequencies, float)
    return s.reshape(-1, *(1,) * (response.ndim - 1)) * response


def extremes(response: FrequencyResponse, index: int) -> list[tuple[str, float, float]]:
    """What stands out in the response of pair `index`: (word, frequency in Hz, magnitude).

    Its first frequency and its peaks and dips in between, as parabolas through three neighbours
    have them.
    """
    f, size = np.asarray(response.frequencies), np.asarray(response.magnitude)[:, index]
    found = [("first", float(f[0]), float(size[0]))]
    for i in range(1, f.size - 1):
        left, rise = size[i - 1] - size[i], size[i + 1] - size[i]
        if left * rise <= 0:
            continue
        curve = np.polyfit(f[i - 1 : i + 2] - f[i], size[i - 1 : i + 2], 2)
        place = -curve[1] / (2 * curve[0])
        word = "dip" if rise > 0 else "peak"
        found.append((word, float(f[i] + place), float(np.polyval(curve, place))))
    return found


def poles(case: Case, parked: Parked = ()) -> Complex[np.ndarray, " state"]:
    """Poles of the rig in 1/s (angular, with the damping as negative real part), by size.

    Plain numbers, not differentiable. Raises ValueError as `frequency_response` does.
    """
    check(case)
    matrix, inertia = _matrices(rig_in_one(case), _parked(case, parked))
    return _sorted(scipy.linalg.eigvals(np.asarray(matrix), np.asarray(inertia)))


def zeros(case: Case, pair: tuple[str, str], parked: Parked = ()) -> Complex[np.ndarray, " zero"]:
    """Zeros of the response of a pair (input, output) in 1/s, by size: where it vanishes.

    For `actuators.I.active_force` as input they are those of the response to the command, which
    has the same. Plain numbers, not differentiable. Raises ValueError as `frequency_response` does.
    """
    check(case)
    (chosen,) = check_pairs(case, [pair])
    model = rig_in_one(case)
    matrix, inertia = _matrices(model, _parked(case, parked))
    pushed, command = column(case, model, chosen.source)
    place, rate, direct = row(case, model, chosen.output)
    through = jnp.atleast_1d(direct @ command)
    still = jnp.block([[matrix, pushed[:, None]], [place, through]])
    moving = jnp.block([[inertia, jnp.zeros_like(pushed)[:, None]], [-rate, jnp.zeros(1)]])
    found = scipy.linalg.eigvals(np.asarray(still), np.asarray(moving))
    # Zeros at infinity come out as such, or as numbers far beyond anything that moves.
    fastest = np.abs(scipy.linalg.eigvals(np.asarray(matrix))).max()
    return _sorted(found[np.abs(found) < 1e4 * fastest])


def _sorted(values):
    """By size, conjugates (whose sizes differ by rounding alone) with the negative one first."""
    sizes = np.array([float(f"{size:.9g}") for size in np.abs(values)])
    return values[np.lexsort((values.imag, sizes))]


def _frequencies(frequencies):
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies, float))
    if frequencies.ndim != 1:
        raise ValueError(f"frequencies must be a list of numbers, not of shape {frequencies.shape}")
    if is_known(frequencies):
        numbers = known(frequencies)
        wrong = ~(np.isfinite(numbers) & (numbers >= 0))
        if wrong.any():
            raise ValueError(
                f"frequencies must be finite and not negative, in Hz; found {numbers[wrong][0]:g}"
            )
    return frequencies


def _parked(case: Case, parked: Parked):
    """Positions (mass,) and masses (mass,) of what is parked."""
    positions = jnp.array([position for position, _ in parked], float).reshape(-1)
    masses = jnp.array([mass for _, mass in parked], float).reshape(-1)
    if is_known(masses):
        for mass in known(masses):
            if not 0 <= mass < np.inf:
                raise ValueError(f"a parked mass must not be negative; it is {mass:g} kg")
    return _on_beam(case, "the place of a parked mass", positions), masses


def _on_beam(case: Case, name: str, x):
    x = jnp.asarray(x, float)
    check_on_beam(name, x, case.beam.length)
    return x
