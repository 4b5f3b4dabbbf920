"""Fits to measured frequency responses (hammer, shaker or commands to actuators), without loads.

    measured = responses_of(log)                      # from a log of commands and readings
    fit = identify_responses(case, measured, ["beam.flexural_rigidity", "beam.damping_ratio"])

Compared are logarithms of the complex responses, ln |H| + i arg H, because errors of measured
responses are relative, at resonances as well as away from them.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Complex, Float

from jaxbeam.case.arguments import check_call, checks_classes
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import OUTSIDE, refuse_traced, refuses_traced
from jaxbeam.model.frequency_responses import StationaryMasses, frequency_response
from jaxbeam.model.modes import mesh_layout
from tuning.fit.least_squares import MAX_STEPS, LeastSquares, confidence_intervals
from tuning.fit.result import ParameterEstimates, parameter_table
from tuning.logs.log import Log
from tuning.parameters import FunctionPrediction, Prior, free_parameters

MIN_RELATIVE_SD = 1e-3  # of a measured response; no sensor is better calibrated


@dataclasses.dataclass(frozen=True, eq=False)
class Responses:
    """Measured frequency responses, a column for each pair of an input and an output.

    `values` are complex, in SI units of output per input; `pairs` are named as in
    `jaxbeam.frequency_response`; `deviations` are relative standard deviations of the values, the
    same for all if left out. `stationary_masses` are (position in m, mass in kg) each.

    Raises ValueError if shapes disagree, frequencies do not ascend from above zero, or a value is
    zero or not finite, and TypeError for fields of other classes.

    >>> import numpy as np
    >>> import tuning
    >>> frequencies = np.array([10.0, 20.0, 40.0])
    >>> values = 1 / (20.0**2 - frequencies**2 + 0.8j * frequencies)
    >>> measured = tuning.fit.Responses(
    ...     frequencies, values[:, None], (("actuators.0", "sensors.0"),)
    ... )
    >>> print(measured.values.shape)
    (3, 1)
    """

    frequencies: Float[np.ndarray, " frequency"]
    values: Complex[np.ndarray, "frequency pair"]
    pairs: tuple[tuple[str, str], ...]
    deviations: Float[np.ndarray, "frequency pair"] | None = None
    stationary_masses: StationaryMasses = ()
    source: str = "responses"

    def __post_init__(self):
        check_call(type(self), (), vars(self))
        refuse_traced("a measured response", OUTSIDE, self.frequencies, self.values)
        if self.values.shape != (self.frequencies.size, len(self.pairs)):
            raise ValueError(
                f"{self.source}: {self.values.shape} values for {self.frequencies.size} "
                f"frequencies and {len(self.pairs)} pairs"
            )
        if not (self.frequencies[0] > 0 and np.all(np.diff(self.frequencies) > 0)):
            raise ValueError(f"{self.source}: frequencies must ascend from above 0 Hz")
        bad = ~np.isfinite(self.values) | (self.values == 0)
        if bad.any():
            i, j = np.argwhere(bad)[0]
            raise ValueError(
                f"{self.source}: the response of {self.pairs[j][1]} to {self.pairs[j][0]} at "
                f"{self.frequencies[i]:g} Hz is {self.values[i, j]}; leave this frequency out"
            )


@checks_classes
def responses_of(log: Log, segment: float | None = None, min_coherence: float = 0.8) -> Responses:
    """Frequency responses of the sensors in a log to the one command in it.

    H1 = S_uy / S_uu by Welch's method with a `segment` in s (an eighth of the log if left out);
    relative standard deviations follow from the coherence g^2, sqrt((1 - g^2) / (2 n g^2)) (Bendat
    and Piersol, Random Data, section 9.1). Frequencies with a coherence below `min_coherence` at
    some sensor are left out. Segments much shorter than the decay bias damping upwards.

    Raises ValueError unless there is one command and a named sensor, for uneven sampling, and if
    hardly any frequency is coherent enough.

    >>> import numpy as np
    >>> import tuning
    >>> u = np.random.default_rng(0).normal(
    ...     size=4000
    ... )  # commands; readings follow a sample later
    >>> values = np.column_stack([u, 2e-3 * np.roll(u, 1)])
    >>> columns = ("u", "w1"), ("voltage", "deflection"), ("V", "m")
    >>> index = {"sensors": (None, 0), "actuators": (0, None)}
    >>> found = tuning.fit.responses_of(
    ...     tuning.Log(0.001 * np.arange(4000), values, *columns, **index)
    ... )
    >>> print(f"{abs(found.values).mean():.1e} m/V")
    2.0e-03 m/V
    """
    commands = [i for i, actuator in enumerate(log.actuators) if actuator is not None]
    sensors = [i for i, sensor in enumerate(log.sensors) if sensor is not None]
    if len(commands) != 1 or not sensors:
        raise ValueError(
            f"{log.source}: responses need one command and at least one sensor; say in the TOML "
            "file beside it which `actuator` and `sensor` its columns are"
        )
    rate = log.sample_rate
    size = int(rate * (log.duration / 8 if segment is None else segment))
    command = log.values[:, commands[0]]
    power = scipy.signal.welch(command, rate, nperseg=size)[1]
    averages = 2 * log.times.size // size - 1
    values, coherences = [], []
    for i in sensors:
        frequencies, cross = scipy.signal.csd(command, log.values[:, i], rate, nperseg=size)
        values.append(cross / np.maximum(power, 1e-300))
        coherences.append(scipy.signal.coherence(command, log.values[:, i], rate, nperseg=size)[1])
    coherence = np.stack(coherences, axis=1)
    kept = (frequencies > 0) & np.all(coherence >= min_coherence, axis=1)
    if kept.sum() < 3:
        raise ValueError(f"{log.source}: hardly any frequency has a coherence of {min_coherence:g}")
    coherence = coherence[kept]
    deviations = np.sqrt((1 - coherence) / (2 * averages * coherence))
    return Responses(
        frequencies[kept],
        np.stack(values, axis=1)[kept],
        tuple(
            (f"actuators.{log.actuators[commands[0]]}", f"sensors.{log.sensors[i]}")
            for i in sensors
        ),
        np.maximum(deviations, MIN_RELATIVE_SD),
        source=log.source,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _ResponseData:
    """Responses as regression data: one log, whose times are frequencies."""

    case: Case
    responses: Responses
    measured: Float[np.ndarray, "1 frequency part"]
    mask: Float[np.ndarray, "1 frequency part"]

    def prediction(self, addresses: list[str]) -> FunctionPrediction:
        """Weighted logarithms of the responses as a function of values at the addresses."""
        case, given = self.case, self.responses
        layout, weights = mesh_layout(case), _weights(given)
        frequencies, measured = jnp.asarray(given.frequencies), jnp.asarray(given.values)

        def predict(values):
            changed = replace(case, dict(zip(addresses, values, strict=True)))
            response = frequency_response(
                changed, frequencies, given.pairs, given.stationary_masses, layout
            ).values
            # Relative to the measured responses, phases do not wrap.
            log_ratio = jnp.log(response / measured)
            parts = jnp.concatenate([log_ratio.real, log_ratio.imag], axis=1)
            return (_weighted_logarithms(given) + parts * weights)[None]

        return FunctionPrediction(predict)


@dataclasses.dataclass(frozen=True, eq=False)
class ResponseFit(ParameterEstimates):
    """Parameters fitted to frequency responses (SI units), named as in `tuning.Fit`.

    `fitted` are the responses with the fitted values; `relative_misfit` is the root mean square of
    their relative difference from the measured ones.
    """

    degrees_of_freedom: float
    verdict: str
    case: Case
    fitted: Complex[np.ndarray, "frequency pair"]
    relative_misfit: Float[np.ndarray, " pair"]

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals; infinite for parameters that are not identifiable."""
        return confidence_intervals(self.values, self.errors, self.degrees_of_freedom)

    def to_dict(self) -> dict:
        """Parameters with their intervals (SI units), misfits by pair and the verdict, for JSON."""
        rows = zip(self.addresses, self.values, self.intervals, strict=True)
        return {
            "numbers": {name: {"value": v, "interval_95": pair} for name, v, pair in rows},
            "misfit": self.relative_misfit,
            "verdict": self.verdict,
        }

    def __str__(self) -> str:
        lines = parameter_table(self.parameters, self.values, self.intervals)
        errors = ", ".join(f"{100 * misfit:.2g} %" for misfit in self.relative_misfit)
        return "\n".join([*lines, f"responses are off by {errors}", self.verdict])


@refuses_traced("a fit")
def identify_responses(
    case: Case,
    measured: Responses,
    free: Mapping[str, tuple[float, float] | Prior | None] | Sequence[str],
    *,
    loss: str = "squares",
) -> ResponseFit:
    """Fit parameters of a case to measured frequency responses.

    Like `tuning.identify` with logs, but in the frequency domain: exact for the modes of the case,
    whatever the excitation was. Loads of the case are left out.

    Raises ValueError for faulty input.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ... )
    >>> frequencies = np.array([10.0, 20.0, 40.0])
    >>> values = jb.frequency_response(case, frequencies).values
    >>> measured = tuning.fit.Responses(frequencies, values, (("actuators.0", "sensors.0"),))
    >>> start = jb.replace(case, {"beam.flexural_rigidity": 11.0})
    >>> fit = tuning.identify_responses(start, measured, ["beam.flexural_rigidity"])
    >>> print(f"{fit.values[0]:.2f} N m^2")
    12.00 N m^2
    """
    bounds = dict(free) if isinstance(free, Mapping) else dict.fromkeys(free)
    parameters = free_parameters([case], bounds, 1.0)
    measured_logarithms = _weighted_logarithms(measured)[None]
    # A first call, not compiled, checks case, pairs and stationary masses.
    frequency_response(case, measured.frequencies[:2], measured.pairs, measured.stationary_masses)
    data = _ResponseData(case, measured, measured_logarithms, np.ones(measured_logarithms.shape))
    found = LeastSquares(data, parameters, loss).solve(measured_logarithms)
    pairs = zip(parameters, found.values, strict=True)
    values = {parameter.address: float(value) for parameter, value in pairs}
    log_difference = ((found.predicted - measured_logarithms)[0] / _weights(measured)).T.reshape(
        2, len(measured.pairs), -1
    )
    relative = (log_difference[0] + 1j * log_difference[1]).T
    return ResponseFit(
        parameters=parameters,
        values=found.values,
        errors=found.uncertainty.errors,
        correlation=found.uncertainty.correlation,
        unidentifiable=found.uncertainty.unidentifiable,
        degrees_of_freedom=found.degrees_of_freedom,
        verdict=(
            "converged"
            if found.converged
            else f"not converged after {MAX_STEPS} steps: start closer"
        ),
        case=replace(case, values),
        fitted=measured.values * np.exp(relative),
        relative_misfit=np.sqrt(np.mean(np.abs(relative) ** 2, axis=0)),
    )


def _weights(responses: Responses) -> Float[np.ndarray, "frequency part"]:
    """Reciprocals of the relative standard deviations, for magnitudes, then phases."""
    if responses.deviations is None:
        return np.ones((responses.frequencies.size, 2 * len(responses.pairs)))
    return np.tile(1 / responses.deviations, (1, 2))


def _weighted_logarithms(responses: Responses) -> Float[np.ndarray, "frequency part"]:
    """Weighted logarithms of magnitudes, then phases (rad)."""
    phases = np.unwrap(np.angle(responses.values), axis=0)
    return np.hstack([np.log(np.abs(responses.values)), phases]) * _weights(responses)
