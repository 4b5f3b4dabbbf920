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
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.channels import ChannelPair, check_pairs, common_pairs, input_column, output_row
from jaxbeam.model.modal_model import ModalModel, compiled_modal_model, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.runtime.compiling import compiled

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

StationaryMasses = Sequence[tuple[Any, Any]]  # position (m) and mass (kg) of each


class FrequencyResponse(eqx.Module):
    """Frequency responses, one column for each pair of an input and an output.

    `values` are complex: output amplitude per input amplitude, with the phase by which the output
    leads, in the `unit` of the pair.
    """

    frequencies: Float[Array, " frequency"]
    values: Complex[Array, "frequency pair"]
    pairs: tuple[ChannelPair, ...] = eqx.field(static=True)
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
        available = ", ".join(map(str, self.pairs))
        raise ValueError(f"there is no response of {output} to {input}; there are {available}")

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
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> FrequencyResponse:
    """Frequency responses of a case at `frequencies` (Hz), its loads away.

    `pairs` are (input, output), each in the words of `ports`; those of `common_pairs` if left
    out. `stationary_masses` are masses that stand on the beam and move with it: (position in m, mass in kg).
    Exact for the modes that the case keeps. Differentiable in every number of the case and in the
    frequencies. Inside `jit`, give the `layout` found outside by `modes.lay_out(case)`.

    Raises ValueError for a faulty case, negative frequencies, an unknown input or output, or a
    parked mass that is negative or off the beam.
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        _stationary_masses(case, stationary_masses),
    )
    checked_pairs = check_pairs(case, common_pairs(case) if pairs is None else pairs)
    layout = mesh_layout(case) if layout is None else layout
    values = _responses(case, layout, frequencies, masses, checked_pairs)
    return FrequencyResponse(frequencies, values, checked_pairs, case.title)


@compiled
def _responses(case: Case, layout: Layout, frequencies, stationary, pairs: tuple[ChannelPair, ...]):
    model = modal_model(case, layout)
    inputs = [input_column(case, model, pair.excitation) for pair in pairs]
    input_matrix = jnp.stack([input_vector for input_vector, _ in inputs], axis=-1)
    states = _state_responses(model, stationary, frequencies, input_matrix)
    s = 2j * jnp.pi * frequencies
    responses = []
    for i, (pair, (_, command)) in enumerate(zip(pairs, inputs, strict=True)):
        response = _evaluate_output(
            output_row(case, model, pair.output), states[:, :, i], s, command
        )
        if pair.excitation != pair.input:  # the input is itself an output of the actuator
            response = response / _evaluate_output(
                output_row(case, model, pair.input), states[:, :, i], s, command
            )
        responses.append(response)
    return jnp.stack(responses, axis=-1)


def _evaluate_output(row, states, s, command):
    state_row, rate_row, feedthrough = row
    return states @ state_row + s * (states @ rate_row) + feedthrough @ command


def _state_responses(
    model: ModalModel, stationary, frequencies, input_matrix
) -> Complex[Array, "frequency state input"]:
    """States of the rig for each column of pushes, at every frequency (Hz)."""
    A, E = _descriptor_matrices(model, stationary)
    s = 2j * jnp.pi * frequencies[:, None, None]
    return jnp.linalg.solve(s * E - A, input_matrix + 0j)


def _descriptor_matrices(model: ModalModel, stationary):
    """A and E of the rig with masses parked on it: their positions (m), and what they are (kg)."""
    A = block_diag(*model.state_matrix)
    positions, kilograms = stationary
    shapes = model.shapes(positions, (0,))[0]
    rates = np.arange(1, 2 * model.modes.stiffness.shape[0], 2)
    added_mass = (shapes.T * kilograms) @ shapes
    return A, jnp.eye(model.state_count).at[np.ix_(rates, rates)].add(added_mass)


def receptance(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Deflection at x per force at y, in m/N: (frequency, x..., y...).

    Positions x and y are in m and may have any shapes. Unlike `frequency_response` it is
    differentiable in them. The rest is as there, the errors too.
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        _stationary_masses(case, stationary_masses),
    )
    layout = mesh_layout(case) if layout is None else layout
    x, y = _checked_position(case, "x", x), _checked_position(case, "y", y)
    return _receptance(case, layout, frequencies, masses, x, y)


@compiled
def _receptance(case: Case, layout: Layout, frequencies, stationary, x, y):
    model = modal_model(case, layout)
    mode_count = model.modes.stiffness.shape[0]
    input_matrix = jnp.zeros((model.state_count, y.size))
    input_matrix = input_matrix.at[1 : 2 * mode_count : 2].set(
        model.shapes(y.reshape(-1), (0,))[0].T
    )
    amplitudes = _state_responses(model, stationary, frequencies, input_matrix)[
        :, : 2 * mode_count : 2
    ]
    response = model.shapes(x.reshape(-1), (0,))[0] @ amplitudes
    return response.reshape(frequencies.size, *x.shape, *y.shape)


def mobility(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Velocity at x per force at y, in m/(N s): H = s x receptance, eq. (2.29) of the thesis."""
    response = receptance(case, frequencies, x, y, stationary_masses, layout)
    return _differentiated(frequencies, response)


def accelerance(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Acceleration at x per force at y, in 1/kg: A = s H = s^2 x receptance."""
    return _differentiated(
        frequencies, mobility(case, frequencies, x, y, stationary_masses, layout)
    )


def _differentiated(frequencies, response):
    s = 2j * jnp.pi * jnp.asarray(frequencies, float)
    return s.reshape(-1, *(1,) * (response.ndim - 1)) * response


def resonances_and_antiresonances(
    response: FrequencyResponse, index: int
) -> list[tuple[str, float, float]]:
    """What stands out in the response of pair `index`: (word, frequency in Hz, magnitude).

    Its first frequency and its peaks and dips in between, as parabolas through three neighbours
    have them.
    """
    f, magnitude = np.asarray(response.frequencies), np.asarray(response.magnitude)[:, index]
    extrema = [("first", float(f[0]), float(magnitude[0]))]
    for i in range(1, f.size - 1):
        left, right = magnitude[i - 1] - magnitude[i], magnitude[i + 1] - magnitude[i]
        if left * right <= 0:
            continue
        curve = np.polyfit(f[i - 1 : i + 2] - f[i], magnitude[i - 1 : i + 2], 2)
        offset = -curve[1] / (2 * curve[0])
        kind = "dip" if right > 0 else "peak"
        extrema.append((kind, float(f[i] + offset), float(np.polyval(curve, offset))))
    return extrema


def poles(case: Case, stationary_masses: StationaryMasses = ()) -> Complex[np.ndarray, " state"]:
    """Poles of the rig in 1/s (angular, with the damping as negative real part), by size.

    Plain numbers, not differentiable. Raises ValueError as `frequency_response` does.
    """
    check_case(case)
    A, E = _descriptor_matrices(
        compiled_modal_model(case), _stationary_masses(case, stationary_masses)
    )
    return _sort_by_magnitude(scipy.linalg.eigvals(np.asarray(A), np.asarray(E)))


def zeros(
    case: Case, pair: tuple[str, str], stationary_masses: StationaryMasses = ()
) -> Complex[np.ndarray, " zero"]:
    """Zeros of the response of a pair (input, output) in 1/s, by size: where it vanishes.

    For `actuators.I.active_force` as input they are those of the response to the command, which
    has the same. Plain numbers, not differentiable. Raises ValueError as `frequency_response` does.
    """
    check_case(case)
    (checked_pair,) = check_pairs(case, [pair])
    model = compiled_modal_model(case)
    A, E = _descriptor_matrices(model, _stationary_masses(case, stationary_masses))
    input_vector, command = input_column(case, model, checked_pair.excitation)
    state_row, rate_row, feedthrough_row = output_row(case, model, checked_pair.output)
    feedthrough = jnp.atleast_1d(feedthrough_row @ command)
    pencil_A = jnp.block([[A, input_vector[:, None]], [state_row, feedthrough]])
    pencil_E = jnp.block([[E, jnp.zeros_like(input_vector)[:, None]], [-rate_row, jnp.zeros(1)]])
    eigenvalues = scipy.linalg.eigvals(np.asarray(pencil_A), np.asarray(pencil_E))
    # Zeros at infinity come out as such, or as numbers far beyond anything that moves.
    largest_pole = np.abs(scipy.linalg.eigvals(np.asarray(A))).max()
    return _sort_by_magnitude(eigenvalues[np.abs(eigenvalues) < 1e4 * largest_pole])


def _sort_by_magnitude(values):
    """By size, conjugates (whose sizes differ by rounding alone) with the negative one first."""
    sizes = np.array([float(f"{size:.9g}") for size in np.abs(values)])
    return values[np.lexsort((values.imag, sizes))]


def _checked_frequencies(frequencies):
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies, float))
    if frequencies.ndim != 1:
        raise ValueError(f"frequencies must be a list of numbers, not of shape {frequencies.shape}")
    if is_concrete(frequencies):
        values = concrete(frequencies)
        invalid = ~(np.isfinite(values) & (values >= 0))
        if invalid.any():
            raise ValueError(
                f"frequencies must be finite and not negative, in Hz; found {values[invalid][0]:g}"
            )
    return frequencies


def _stationary_masses(case: Case, stationary_masses: StationaryMasses):
    """Positions (mass,) and masses (mass,) of what is parked."""
    positions = jnp.array([position for position, _ in stationary_masses], float).reshape(-1)
    masses = jnp.array([mass for _, mass in stationary_masses], float).reshape(-1)
    if is_concrete(masses):
        for mass in concrete(masses):
            if not 0 <= mass < np.inf:
                raise ValueError(f"a parked mass must not be negative; it is {mass:g} kg")
    return _checked_position(case, "the place of a parked mass", positions), masses


def _checked_position(case: Case, name: str, x):
    x = jnp.asarray(x, float)
    check_on_beam(name, x, case.beam.length)
    return x
