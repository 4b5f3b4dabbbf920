"""Parameters of a case from identified modes, by gradients through the eigenvalue problem.

    fit = identify_from_modes(case, identify_modes(log), {"beam.flexural_rigidity": (1e6, 1e8)})

Frequencies, damping ratios and shapes of the case are compared with the identified ones, weighted
by their covariance (Friswell and Mottershead, Finite Element Model Updating in Structural Dynamics,
chapter 8). Modes are paired by frequency and modal assurance criterion, anew at every solution.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.stats import norm

from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import refuses_traced
from jaxbeam.model.modes import mesh_layout, modes
from jaxbeam.runtime.printer import counted
from tuning.fit.least_squares import WEAK_PRIOR_WIDTH, t_quantile, uncertainty
from tuning.fit.result import ParameterEstimates, parameter_table
from tuning.modal.result import ModalEstimates, mac_matrix
from tuning.parameters import Prior, free_parameters, to_unbounded

MIN_RELATIVE_FREQUENCY_SD = 1e-4  # of a frequency; clocks and temperature allow no better
MIN_RELATIVE_DAMPING_SD = 1e-2
MIN_SHAPE_SD = 1e-2  # of a component over the largest: calibration and places of sensors
MAX_PAIRINGS = 6


@dataclasses.dataclass(frozen=True, eq=False)
class ModalParameterFit(ParameterEstimates):
    """Parameters fitted to identified modes (SI units), named as in `tuning.Fit`.

    `pairs` are (identified mode, mode of the case), counted from 0, with their modal assurance
    criterion (1 without shapes); `frequencies` those of the fitted case (Hz) for each pair.
    `misfit` is the root mean square of the residuals in standard deviations; beyond one, the errors
    are widened by it.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> times = 0.005 * np.arange(1600)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=times.size)
    >>> columns = ("a1",), ("acceleration",), ("m/s^2",)
    >>> fit = tuning.identify_modes(tuning.Log(times, (decay + noise)[:, None], *columns))
    >>> case = jb.Case(jb.Beam(20.0, 8e9, 12e3, modes=1), sensors=[jb.Sensor(10.0)])
    >>> found = tuning.identify_from_modes(case, fit, ["beam.flexural_rigidity"])
    >>> print(found.addresses, f"{found.values[0]:.2e} N m^2")
    ['beam.flexural_rigidity'] 7.97e+09 N m^2
    """

    quantile: float
    misfit: float
    pairs: tuple[tuple[int, int, float], ...]
    frequencies: Float[np.ndarray, " pair"]
    identified: ModalEstimates
    case: Case

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals; infinite for parameters that the modes do not determine."""
        half = self.quantile * self.errors
        return np.stack([self.values - half, self.values + half], axis=1)

    def __str__(self) -> str:
        lines = list(parameter_table(self.parameters, self.values, self.intervals))
        for (mine, other, mac), frequency in zip(self.pairs, self.frequencies, strict=True):
            measured = self.identified.modes[mine].frequency
            lines.append(
                f"mode {other + 1} of the case: {frequency:.4f} Hz, identified {measured:.4f} Hz, "
                f"MAC {mac:.3f}"
            )
        lines.append(f"residuals are {self.misfit:.2g} standard deviations (rms)")
        for change in self.unidentifiable:
            listed = ", ".join(f"{address} {step:+.2g}" for address, step in change.items())
            lines.append(f"the modes do not tell changes of {listed} together")
        return "\n".join(lines)

    def to_dict(self) -> dict:
        """Parameters with their intervals (SI units), pairs of modes and misfit, for JSON."""
        rows = zip(self.addresses, self.values.tolist(), self.intervals.tolist(), strict=True)
        return {
            "numbers": {name: {"value": v, "interval_95": pair} for name, v, pair in rows},
            "pairs": [
                {"identified": mine, "mode": other, "mac": mac} for mine, other, mac in self.pairs
            ],
            "misfit": self.misfit,
            "unidentifiable": self.unidentifiable,
        }


@refuses_traced("a fit")
def identify_from_modes(
    case: Case,
    identified: ModalEstimates,
    free: Mapping[str, tuple[float, float] | Prior | None] | Sequence[str],
) -> ModalParameterFit:
    """Fit parameters of a case to identified modes.

    Shapes count if the log has the positions of its sensors, all of one quantity, or says which
    sensors of the case they are; `identified` may also be of several setups (`merge_setups`).
    Damping ratios count if a damping of the case is free.

    Raises ValueError without identified modes, for more parameters than data, and for fewer modes
    of the case than were identified.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> times = 0.005 * np.arange(1600)
    >>> decay = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    >>> columns = ("a1",), ("acceleration",), ("m/s^2",)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=times.size)
    >>> modes = tuning.identify_modes(tuning.Log(times, (decay + noise)[:, None], *columns))
    >>> case = jb.Case(jb.Beam(20.0, 8e9, 12e3, modes=1), sensors=[jb.Sensor(10.0)])
    >>> fit = tuning.identify_from_modes(case, modes, ["beam.flexural_rigidity"])
    >>> print(f"{float(fit.case.beam.flexural_rigidity):.2e} N m^2")
    7.97e+09 N m^2
    """
    if not identified.modes:
        raise ValueError(f"{identified.source}: no mode is well identified, nothing to fit to")
    bounds = dict(free) if isinstance(free, Mapping) else dict.fromkeys(free)
    parameters = free_parameters([case], bounds, 1.0)
    places = _places(case, identified)
    with_damping = any("damping" in parameter.address for parameter in parameters)
    layout, addresses = mesh_layout(case), [parameter.address for parameter in parameters]

    def solved(values):
        found = modes(replace(case, dict(zip(addresses, values, strict=True))), layout)
        shapes = jnp.zeros((0, found.frequencies.size)) if places is None else found.shapes(places)
        return found.frequencies, found.damping_ratios, shapes

    start = np.array([parameter.start for parameter in parameters], float)
    frequencies, _, shapes = map(np.asarray, solved(start))
    if frequencies.size < len(identified.modes):
        raise ValueError(
            f"the case has {counted(frequencies.size, 'mode')}, {len(identified.modes)} were"
            " identified: raise beam.modes"
        )
    y = np.asarray(to_unbounded(parameters, start))
    pairs = _paired(identified, frequencies, shapes, places is not None)
    for _ in range(MAX_PAIRINGS):
        y, values, residuals, jacobian = _solve(
            identified, pairs, solved, parameters, y, places is not None, with_damping
        )
        frequencies, _, shapes = map(np.asarray, solved(values))
        again = _paired(identified, frequencies, shapes, places is not None)
        if [p[:2] for p in again] == [p[:2] for p in pairs]:
            break
        pairs = again
    count = residuals.size - len(parameters)
    misfit = float(np.sqrt(np.mean(residuals**2)))
    excess = np.sqrt(np.sum(residuals**2) / count) if count > 0 else 1.0
    widened = max(float(excess), 1.0)
    sizes = np.array([parameter.typical_size for parameter in parameters], float)
    found = uncertainty(addresses, jacobian / widened, sizes)
    final = {a: float(v) for a, v in zip(addresses, values, strict=True)}
    return ModalParameterFit(
        parameters=parameters,
        values=values,
        errors=found.errors,
        correlation=found.correlation,
        unidentifiable=found.unidentifiable,
        quantile=t_quantile(float(count)) if widened > 1 else float(norm.ppf(0.975)),
        misfit=misfit,
        pairs=again,
        frequencies=frequencies[[other for _, other, _ in again]],
        identified=identified,
        case=replace(case, final),
    )


def _places(case: Case, identified: ModalEstimates) -> Float[np.ndarray, " channel"] | None:
    """Positions (m) of the channels; None if not given, or not of one quantity of motion."""
    channels, places = identified.channels, []
    for i, position in enumerate(channels.positions):
        sensor = channels.sensors[i]
        if position is None and sensor is not None and sensor < len(case.sensors):
            position = float(case.sensors[sensor].position)
        places.append(position)
    of_motion = set(channels.quantities) <= {"deflection", "velocity", "acceleration"}
    alike = of_motion and len(set(channels.quantities)) == 1
    return np.array(places) if alike and len(places) > 1 and None not in places else None


def _paired(identified: ModalEstimates, frequencies, shapes, has_shapes) -> tuple:
    """Pairs of identified modes and modes of the case with the least sum of distances."""
    mine = identified.frequencies
    cost = np.abs(np.log(mine[:, None] / np.maximum(frequencies, 1e-9)))
    mac = np.ones(cost.shape)
    if has_shapes:
        mac = mac_matrix(identified.shapes, shapes.T.astype(complex))
        cost = cost + (1 - mac)
    rows, columns = scipy.optimize.linear_sum_assignment(cost)
    return tuple((int(i), int(j), float(mac[i, j])) for i, j in zip(rows, columns, strict=True))


def _solve(identified, pairs, solved, parameters, y, has_shapes, with_damping):
    """Least-squares solution: search variables, values, residuals, and Jacobian by the values.

    The search begins at the search variables y.
    """
    chosen = np.array([other for _, other, _ in pairs])
    measured = [identified.modes[mine] for mine, _, _ in pairs]
    f = np.array([mode.frequency for mode in measured])
    f_sd = np.array([mode.frequency_sd for mode in measured])
    f_sd = np.maximum(f_sd / f, MIN_RELATIVE_FREQUENCY_SD)
    z = np.array([mode.damping_ratio for mode in measured])
    z_sd = np.array([mode.damping_sd for mode in measured]) / z
    z_sd = np.maximum(z_sd, MIN_RELATIVE_DAMPING_SD)
    largest = [int(np.nanargmax(np.abs(mode.shape.real))) for mode in measured]
    whitening = [_whitening(mode, k) for mode, k in zip(measured, largest, strict=True)]

    def residual(values):
        frequencies, damping, shapes = solved(values)
        parts = [(jnp.log(frequencies[chosen]) - np.log(f)) / f_sd]
        if with_damping:
            parts.append((jnp.log(damping[chosen]) - np.log(z)) / z_sd)
        if has_shapes:
            for i, mode in enumerate(measured):
                own = shapes[:, chosen[i]] / shapes[largest[i], chosen[i]]
                given = np.nan_to_num(mode.shape.real) / mode.shape.real[largest[i]]
                parts.append(whitening[i] @ (own - given))
        parts.append(jnp.stack([p.prior.prior_residual(values[i])
                                for i, p in enumerate(parameters)]))  # fmt: skip
        return jnp.concatenate(parts)

    def values_at(point):
        return jnp.stack([p.from_unbounded(point[i]) for i, p in enumerate(parameters)])

    both = jax.jit(lambda point: (residual(values_at(point)),
                                  jax.jacfwd(lambda p: residual(values_at(p)))(point)))  # fmt: skip
    # A weak prior around the start bounds directions that the modes leave free; not in the errors.
    widths = WEAK_PRIOR_WIDTH * np.array([p.unbounded_size for p in parameters])
    found = scipy.optimize.least_squares(
        lambda point: np.concatenate([np.asarray(both(point)[0]), (point - y) / widths]),
        y,
        lambda point: np.vstack([np.asarray(both(point)[1]), np.diag(1 / widths)]),
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
    )
    values = np.asarray(values_at(jnp.asarray(found.x)))
    slopes = np.diag(np.asarray(jax.jacfwd(values_at)(jnp.asarray(found.x))))
    count = len(parameters)
    with_prior = [p.prior.mean is not None for p in parameters]
    kept = np.concatenate([np.ones(found.fun.size - 2 * count, bool), with_prior])
    return found.x, values, found.fun[:-count][kept], (found.jac / slopes)[:-count][kept]


def _whitening(mode, largest: int) -> Float[np.ndarray, "row channel"]:
    """Matrix that whitens the real parts of a mode shape, to unit covariance.

    The `largest` component, which is scaled to 1, has no row, nor have those not measured.
    """
    others = [i for i in np.flatnonzero(np.isfinite(mode.shape)) if i != largest]
    covariance = mode.shape_covariance[np.ix_(others, others)]
    covariance = covariance + MIN_SHAPE_SD**2 * np.eye(len(others))
    rows = np.zeros((len(others), mode.shape.size))
    rows[:, others] = np.linalg.inv(np.linalg.cholesky(covariance))
    return rows
