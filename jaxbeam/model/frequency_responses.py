"""Frequency responses of beam, absorbers and actuators, with stationary masses on the beam.

With the states z of the modal model and s = 2 pi i f,

    (s E - A) z = B u + shapes(y) . force,    y = (C + s C') z + D u.

E is the identity plus the stationary masses, eq. (2.30) of the thesis; C' acts on the rates z'.
Heights and rates of the absorbers' bodies follow the states of the model.
"""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import concrete, is_concrete, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.model.channels import ChannelPair, check_pairs, common_pairs, input_column, output_row
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.runtime.arrays import Array, add_at, set_at, solve, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    from matplotlib.figure import Figure, SubFigure

__all__ = [
    "accelerance",
    "frequency_response",
    "mobility",
    "receptance",
]

StationaryMasses = Sequence[tuple[Any, Any]]  # position (m) and mass (kg) of each


class FrequencyResponse(TableViews, Module):
    """Frequency responses at `frequencies` (Hz), one column for each pair of input and output.

    `values` are complex amplitudes of the output per input, in the `unit` of the pair; their phase
    is that by which the output leads.
    """

    frequencies: Float[Array, " frequency"]
    values: Complex[Array, "frequency pair"]
    pairs: tuple[ChannelPair, ...] = eqx.field(static=True)
    title: str = eqx.field(static=True, default="")

    def __repr__(self) -> str:
        pairs = "".join(f"\n  {p}" + f", in {p.unit}" * (p.unit != "1") for p in self.pairs)
        if not is_concrete(self.frequencies):
            return f"FrequencyResponse{pairs}"
        first, last = concrete(self.frequencies)[[0, -1]]
        count = self.frequencies.size
        return f"FrequencyResponse at {count} frequencies, {first:.4g} to {last:.4g} Hz{pairs}"

    @property
    def magnitude(self) -> Float[Array, "frequency pair"]:
        """Amplitude of the output per amplitude of the input, in the unit of the pair."""
        return xp.abs(self.values)

    @property
    def phase(self) -> Float[Array, "frequency pair"]:
        """Phase by which the output leads the input in degrees, without jumps of a full turn."""
        return xp.degrees(xp.unwrap(xp.angle(self.values), axis=0))

    def of(self, input: str, output: str) -> Complex[Array, " frequency"]:
        """Response of one pair. Raises ValueError if there is none of it."""
        for i, pair in enumerate(self.pairs):
            if (pair.input, pair.output) == (input, output):
                return self.values[:, i]
        available = ", ".join(map(str, self.pairs))
        raise ValueError(f"there is no response of {output} to {input}; there are {available}")

    def plot(self, **options: Any) -> "Figure | SubFigure":
        """Magnitude and phase; see `jaxbeam.plot.plot_frequency_response` and its options."""
        from jaxbeam.plot import plot_frequency_response

        return plot_frequency_response(self, **options)

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Frequency (Hz), and magnitude and phase (degrees) of each pair, by head."""
        columns = {"frequency (Hz)": np.asarray(self.frequencies)}
        magnitude, phase = np.asarray(self.magnitude), np.asarray(self.phase)
        for i, pair in enumerate(self.pairs):
            unit = "" if pair.unit == "1" else f" ({pair.unit})"
            columns[f"{pair} magnitude{unit}"] = magnitude[:, i]
            columns[f"{pair} phase (degree)"] = phase[:, i]
        return columns

    @refuses_traced("a dataset")
    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units, of real variables that every file format can hold."""
        dims = ("frequency", "pair")
        values = np.asarray(self.values)
        return labelled_dataset(
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
        with whole_file(path, overwrite) as partial:
            self.to_xarray().to_netcdf(partial, engine="scipy")


def frequency_response(
    case: Case,
    frequencies,
    pairs: Sequence[tuple[str, str]] | None = None,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> FrequencyResponse:
    """Frequency responses of a case at `frequencies` (Hz), without its loads.

    `pairs` are (input, output) by the names of `channels`, by default those of `common_pairs`.
    `stationary_masses` are pairs of position (m) and mass (kg) that vibrate with the beam. Exact
    for the modes that the case keeps. Differentiable in every number of the case and in the
    frequencies. Inside `jit`, pass the `layout` found outside by `model.modes.mesh_layout(case)`.

    Raises ValueError for an invalid case, negative frequencies, an unknown input or output, or a
    stationary mass that is negative or off the beam.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> responses = jb.frequency_response(case, [5.0, 20.0])
    >>> print(responses.values.shape)  # frequency, pair
    (2, 1)
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        checked_masses(case, stationary_masses),
    )
    checked_pairs = check_pairs(case, common_pairs(case) if pairs is None else pairs)
    layout = mesh_layout(case) if layout is None else layout
    values = _responses(case, layout, frequencies, masses, checked_pairs)
    return FrequencyResponse(frequencies, values, checked_pairs, case.title)


@compiled_if_traced
def _responses(case: Case, layout: Layout, frequencies, stationary, pairs: tuple[ChannelPair, ...]):
    model = modal_model(case, layout)
    inputs = [input_column(case, model, pair.excitation) for pair in pairs]
    input_matrix = xp.stack([input_vector for input_vector, _ in inputs], axis=-1)
    states = _state_responses(case, model, stationary, frequencies, input_matrix)
    s = 2j * xp.pi * frequencies
    responses = []
    for i, (pair, (_, command)) in enumerate(zip(pairs, inputs, strict=True)):
        response = _evaluate_output(
            output_row(case, model, pair.output), states[:, :, i], s, command
        )
        if pair.excitation != pair.input:  # an active force is itself an output: take the ratio
            response = response / _evaluate_output(
                output_row(case, model, pair.input), states[:, :, i], s, command
            )
        responses.append(response)
    return xp.stack(responses, axis=-1)


def _evaluate_output(row, states, s, command):
    state_row, rate_row, feedthrough = row
    return states @ state_row + s * (states @ rate_row) + feedthrough @ command


def _state_responses(
    case: Case, model: ModalModel, stationary, frequencies, input_matrix
) -> Complex[Array, "frequency state input"]:
    """States per unit of each input (column of the input matrix), at every frequency (Hz)."""
    A, E = descriptor_matrices(case, model, stationary)
    s = 2j * xp.pi * frequencies[:, None, None]
    added = A.shape[0] - model.state_count
    states = solve(s * E - A, xp.pad(input_matrix, ((0, added), (0, 0))) + 0j)
    return states[:, : model.state_count]


def descriptor_matrices(case: Case, model: ModalModel, stationary):
    """A and E of the model with absorbers and stationary masses: (positions in m, masses in kg).

    Heights and rates of the absorbers' bodies follow the states of the model, as oscillators
    equivalent to them (see `jaxbeam.case.absorbers`).
    """
    positions, kilograms = stationary
    shapes = model.shapes(positions, (0,))[0]
    added_mass = (shapes.T * kilograms) @ shapes
    rates, coordinates = model.rate_index, model.coordinate_index
    A, E = model.A, add_at(xp.eye(model.state_count), (rates, rates), added_mass)
    for absorber in case.absorbers:
        oscillator, body = absorber.vehicle(case.run.gravity), A.shape[0]
        shape = model.shapes(xp.reshape(absorber.position, 1), (0,))[0]
        A, E = (xp.pad(matrix, (0, 2)) for matrix in (A, E))
        A = set_at(A, (body, body + 1), 1.0)
        identity = np.eye(2)
        E = set_at(E, np.s_[body:, body:], identity)
        # The pull of spring and damper over the mass of the body, and on the modes.
        for columns, own, factor in (
            (coordinates, body, oscillator.contact_stiffness),
            (rates, body + 1, oscillator.contact_damping),
        ):
            on_body = factor / oscillator.mass[0, 0]
            A = add_at(A, (rates, columns), -factor * shape.T @ shape)
            A = add_at(A, (rates, own), factor * shape[0])
            A = add_at(A, (body + 1, columns), on_body * shape[0])
            A = add_at(A, (body + 1, own), -on_body[0])
        E = add_at(E, (rates, rates), oscillator.wheel_masses * shape.T @ shape)
    return A, E


def receptance(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Receptance: deflection at x per force at y, in m/N, (frequency, x..., y...).

    Positions x and y (m) may have any shapes; differentiable in them too. Other arguments and
    errors are those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> static = jb.frequency_responses.receptance(jb.Case(beam), [0.0], 0.3, 0.3)
    >>> print(f"{abs(static[0]) * 48 * 11.68 / 0.6**3:.3f}")  # of three modes; over L^3 / (48 E I)
    0.998
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        checked_masses(case, stationary_masses),
    )
    layout = mesh_layout(case) if layout is None else layout
    x, y = _checked_position(case, "x", x), _checked_position(case, "y", y)
    return _receptance(case, layout, frequencies, masses, x, y)


@compiled_if_traced
def _receptance(case: Case, layout: Layout, frequencies, stationary, x, y):
    model = modal_model(case, layout)
    input_matrix = xp.zeros((model.state_count, y.size))
    input_matrix = set_at(input_matrix, model.rate_index, model.shapes(y.reshape(-1), (0,))[0].T)
    states = _state_responses(case, model, stationary, frequencies, input_matrix)
    amplitudes = states[:, model.coordinate_index]
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
    """Mobility: velocity at x per force at y, in m/(N s); s x receptance, eq. (2.29).

    Positions are those of `receptance`, other arguments those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print(jb.frequency_responses.mobility(jb.Case(beam), [10.0, 20.0], 0.3, 0.3).shape)
    (2,)
    """
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
    """Accelerance: acceleration at x per force at y, in 1/kg, s^2 x receptance.

    Positions are those of `receptance`, other arguments those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print(jb.frequency_responses.accelerance(jb.Case(beam), [10.0], 0.3, 0.3).shape)
    (1,)
    """
    return _differentiated(
        frequencies, mobility(case, frequencies, x, y, stationary_masses, layout)
    )


def _differentiated(frequencies, response):
    s = 2j * xp.pi * xp.asarray(frequencies, float)
    return s.reshape(-1, *(1,) * (response.ndim - 1)) * response


def resonances_and_antiresonances(
    response: FrequencyResponse, index: int
) -> list[tuple[str, float, float]]:
    """Features of the response of pair `index`: (kind, frequency in Hz, magnitude).

    "first" is that at the first frequency; each "peak" and "dip" is the vertex of the parabola
    through three neighbouring frequencies.
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


def _checked_frequencies(frequencies):
    frequencies = xp.atleast_1d(xp.asarray(frequencies, float))
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


def checked_masses(case: Case, stationary_masses: StationaryMasses):
    """Positions (mass,) in m and masses (mass,) in kg, after checks.

    Raises ValueError for a negative mass and a position off the beam.
    """
    positions = xp.array([position for position, _ in stationary_masses], float).reshape(-1)
    masses = xp.array([mass for _, mass in stationary_masses], float).reshape(-1)
    if is_concrete(masses):
        for mass in concrete(masses):
            if not 0 <= mass < np.inf:
                raise ValueError(f"a stationary mass must not be negative; it is {mass:g} kg")
    return _checked_position(case, "the position of a stationary mass", positions), masses


def _checked_position(case: Case, name: str, x):
    x = xp.asarray(x, float)
    check_on_beam(name, x, case.beam.length)
    return x
