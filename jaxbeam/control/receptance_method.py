"""Receptance method of pole placement: gains of displacement and velocity feedback.

An actuator is driven by the deflections at the sensors, u = g . w(t - tau) + f . w'(t - tau). With
the receptances r(s), the deflections per command, a pole s of the loop satisfies

    exp(-s tau) (g + s f) . r(s) = 1,

which is linear in g and f: poles are assigned from receptances alone, without mass, stiffness or
damping matrices (Ram and Mottershead, AIAA Journal 45, 2007; with delays Ram, Singh and
Mottershead, Mechanical Systems and Signal Processing 23, 2009). An open-loop pole s whose mode has
the deflections v at the sensors stays where (g + s f) . v = 0. Actuators with dynamics are part of
the receptances.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import OUTSIDE, concrete, refuse_traced, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedback import OutputFeedback
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.runtime.arrays import Array, Module, is_jax, solve, xp

__all__ = [
    "ReceptanceFeedback",
    "closed_loop_poles",
    "fit_receptances",
    "receptance_feedback",
    "receptance_gains",
    "receptances",
]

COLLOCATION_NODES = 24  # over a delay; the rightmost poles are refined afterwards
REFINEMENTS = 20  # at most, of each pole
MAX_TURN = 300.0  # |s| times the delay


class ReceptanceFeedback(Module):
    """Law u = g . w(t - delay) + f . w'(t - delay) of an actuator; w are deflections at sensors.

    `displacement` are the gains g (command per m), `velocity` the gains f (command per m/s),
    `delay` is in s. `actuator` is the index of the actuator.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> gains = np.array([-200.0]), np.array([-5.0])
    >>> law = jb.receptance_method.ReceptanceFeedback(*gains, delay=np.float64(1e-3))
    >>> print(law.displacement, law.velocity)
    [-200.] [-5.]
    """

    displacement: Float[Array, " sensor"]
    velocity: Float[Array, " sensor"]
    delay: Float[Array, ""]
    actuator: int = eqx.field(static=True, default=0)

    @checks_classes
    def controller(self, case: Case, period: float | None = None) -> OutputFeedback:
        """Controller of a case whose sensors measure the deflections, then their velocities.

        With a sampling `period` (s), by which a delay is implemented. Raises ValueError if the case
        has other sensors, or for a delay without a period.
        """
        count = self.displacement.shape[0]
        quantities = [sensor.quantity for sensor in case.sensors]
        if quantities != ["deflection"] * count + ["velocity"] * count:
            raise ValueError(
                f"the law needs {count} sensors of deflection, then {count} of velocity at the same"
                f" positions; the case has {', '.join(quantities) or 'none'}"
            )
        delay = float(concrete(self.delay))
        if delay and period is None:
            raise ValueError("a delay needs a sampling period: give period in s")
        driven = commanded(case.actuators)
        if self.actuator not in driven:
            raise ValueError(f"actuators.{self.actuator} of the case takes no command")
        own = np.arange(len(driven)) == driven.index(self.actuator)
        gains = own[:, None] * xp.concatenate([self.displacement, self.velocity])
        return OutputFeedback(gains=gains, period=period, delay=self.delay if delay else None)


@checks_classes
def receptances(case: Case, s, actuator: int = 0) -> Complex[Array, "pole sensor"]:
    """Deflections at the sensors per command of an actuator, at complex s (1/s), in m per command.

    Of the beam with supports and actuators, without loads and filters of sensors. Raises ValueError
    for an invalid case, or an actuator that it does not have.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> print(jb.receptance_method.receptances(case, [10j, 20j]).shape)
    (2, 1)
    """
    model = _checked_model(case, actuator)
    s = xp.asarray(s) + 0j
    matrix = s[:, None, None] * xp.eye(model.state_count) - model.A
    drive = xp.broadcast_to(model.command_matrix[:, actuator], (s.shape[0], model.state_count))
    states = solve(matrix, drive[..., None] + 0j)[..., 0]
    return states[:, model.coordinate_index] @ _sensor_shapes(case, model).T


@checks_classes
def fit_receptances(
    frequencies: ArrayLike, values: ArrayLike, tolerance: float = 1e-9
) -> Callable[[ArrayLike], Complex[np.ndarray, "pole sensor"]]:
    """Receptances as functions of complex s, from measured ones at `frequencies` (Hz).

    `values` (frequency, sensor) are deflections per command, in m per command. Poles lie off the
    axis of frequencies, so a rational function is fitted to the values and their conjugates, for
    each sensor, to a relative `tolerance`: that of the noise (AAA: Nakatsukasa, Sete and Trefethen,
    SIAM Journal on Scientific Computing 40, 2018). Raises ValueError for arrays that do not fit.

    >>> import numpy as np
    >>> frequencies = np.linspace(0.1, 2.0, 40)
    >>> s = 2j * np.pi * frequencies
    >>> fitted = fit_receptances(frequencies, 1 / (s**2 + 0.4 * s + 16)[:, None])
    >>> print(np.allclose(fitted(1.0 + 3.0j), 1 / ((1 + 3j) ** 2 + 0.4 * (1 + 3j) + 16)))
    True
    """
    from scipy.interpolate import AAA  # imported here: it takes longer than all else

    frequencies, values = np.asarray(frequencies, float), np.asarray(values, complex)
    if frequencies.ndim != 1 or values.ndim != 2 or len(values) != len(frequencies):
        raise ValueError(
            "frequencies must be (frequency,) and values (frequency, sensor), not"
            f" {frequencies.shape} and {values.shape}"
        )
    points = 2j * np.pi * frequencies
    both = np.concatenate([points, points.conj()])
    fits = [
        AAA(both, np.concatenate([column, column.conj()]), rtol=tolerance) for column in values.T
    ]
    return lambda s: np.stack([fit(np.asarray(s, complex)) for fit in fits], axis=-1)


@checks_classes
def receptance_gains(
    assigned: ArrayLike,
    poles: ArrayLike,
    delay: float = 0.0,
    kept: ArrayLike = (),
    kept_poles: ArrayLike = (),
    actuator: int = 0,
) -> ReceptanceFeedback:
    """Feedback that assigns `poles` (1/s) to the closed loop and keeps other poles.

    `assigned` (pole, sensor) are the receptances at the poles, one of each conjugate pair. The
    modes of the open-loop poles `kept_poles` (1/s) with deflections `kept` (pole, sensor) at the
    sensors do not change. A complex pole takes two gains, a real pole one; where gains are left,
    the smallest are taken. Raises ValueError if there are too few sensors, or if the poles
    cannot be assigned, and for traced numbers other than receptances `assigned`.

    The `actuator` is driven with the `delay` (s) from measurement to command.

    >>> import numpy as np
    >>> pole = -1.0 + 5.0j
    >>> assigned = (
    ...     1 / (pole**2 + 16) * np.ones((1, 1))
    ... )  # of a mass of 1 kg on a spring of 16 N/m
    >>> law = receptance_gains(assigned, [pole])
    >>> closed = pole**2 + 16 - (law.displacement + pole * law.velocity)
    >>> print(np.abs(closed).max() < 1e-9)
    True
    """
    refuse_traced("an assignment of poles", "only receptances may be", poles, delay, kept_poles)
    assigned, poles = xp.asarray(assigned) + 0j, np.asarray(poles, complex)
    count = assigned.shape[1]
    kept = np.asarray(kept, complex).reshape(-1, count)
    kept_poles = np.asarray(kept_poles, complex).reshape(-1)
    # Velocities by the size of the poles: gains of both kinds then are of one size.
    scale = float(np.mean(np.abs(poles)))
    delayed = assigned * np.exp(-poles * delay)[:, None]
    rows = xp.concatenate([delayed, kept * xp.max(xp.abs(delayed))])
    all_poles = np.concatenate([poles, kept_poles])
    system = xp.concatenate([rows, rows * all_poles[:, None] / scale], axis=1)
    right = xp.concatenate([xp.ones(poles.shape[0]), xp.zeros(kept_poles.shape[0])])
    complex_rows = np.abs(all_poles.imag) > 1e-9 * scale
    system = xp.concatenate([system.real, system.imag[complex_rows]])
    right = xp.concatenate([right, xp.zeros(int(complex_rows.sum()))])
    if system.shape[0] > 2 * count:
        raise ValueError(
            f"{system.shape[0]} real conditions for poles exceed the {2 * count} gains of {count}"
            " sensors: assign or keep fewer poles, or add sensors"
        )
    # Rows of one size: receptances at resonances are larger by orders of magnitude than others.
    size = xp.max(xp.abs(system), axis=1, keepdims=True)
    gains = xp.linalg.pinv(system / size) @ (right / size[:, 0])
    if not is_jax(gains) and not np.allclose(system @ gains, right, rtol=0.0, atol=1e-6):
        raise ValueError(
            "these poles cannot be assigned with these sensors: their conditions contradict each"
            " other; move a sensor away from nodes, or assign fewer poles"
        )
    return ReceptanceFeedback(gains[:count], gains[count:] / scale, xp.asarray(delay), actuator)


@checks_classes
def receptance_feedback(
    case: Case,
    poles: ArrayLike,
    *,
    keep: Sequence[int] = (),
    delay: float = 0.0,
    actuator: int = 0,
) -> ReceptanceFeedback:
    """Feedback of deflections at the sensors, and their rates, that assigns poles (1/s).

    `poles` are one of each conjugate pair; `keep` are the indices, from 0, of modes whose poles and
    shapes stay, in the order of their frequencies with supports and actuators. Loads and filters
    are left out. Differentiable in the numbers of the case, unless modes are kept. Raises
    ValueError as `receptance_gains` does, for an invalid case, for modes that it does not have, and
    for a traced one whose modes are kept.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=12),
    ...     actuators=[jb.PointForce(position=0.21)],
    ...     sensors=[jb.Sensor(position=0.18), jb.Sensor(position=0.39)],
    ... )
    >>> law = jb.receptance_method.receptance_feedback(case, [-12.8 + 127.5j, -30.7 + 511.5j])
    >>> bool(abs(jb.receptance_method.closed_loop_poles(case, law) - (-12.8 + 127.5j)).min() < 1e-8)
    True
    """
    model = _checked_model(case, actuator)
    shapes, kept_poles = np.zeros((0, len(case.sensors))), np.zeros(0)
    if len(keep):
        refuse_traced("a feedback that keeps modes", OUTSIDE, case)
        found, vectors = _oscillating_modes(case)
        if min(keep) < 0 or max(keep) >= len(found):
            raise ValueError(f"keep must list modes from 0 to {len(found) - 1}, not {list(keep)}")
        kept_poles = found[list(keep)]
        vectors = vectors[model.coordinate_index, list(keep)]
        shapes = (_sensor_shapes(case, model) @ vectors).T
        shapes = shapes / np.abs(shapes).max(axis=1, keepdims=True)
    assigned = receptances(case, poles, actuator)
    return receptance_gains(assigned, poles, delay, shapes, kept_poles, actuator)


@refuses_traced("a list of poles")
def closed_loop_poles(
    case: Case, feedback: ReceptanceFeedback, delay: float | None = None, count: int = 24
) -> Complex[np.ndarray, " pole"]:
    """Rightmost poles (1/s) of the loop of a `feedback`, imaginary part not negative, in order.

    A delayed loop has infinitely many poles: the equation is collocated at Chebyshev points over
    the delay (Breda, Maset and Vermiglio, SIAM Journal on Scientific Computing 27, 2005), and the
    `count` rightmost poles are refined by inverse iteration. `delay` (s) may differ from that of
    the design, which tells how robust it is. Loads and filters are left out. Raises ValueError for
    an invalid case, and for numbers that are traced.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535),
    ...     actuators=[jb.PointForce(position=0.21)],
    ...     sensors=[jb.Sensor(position=0.18), jb.Sensor(position=0.39)],
    ... )
    >>> law = jb.receptance_method.receptance_feedback(case, [-12.8 + 127.5j, -30.7 + 511.5j])
    >>> bool(abs(jb.receptance_method.closed_loop_poles(case, law) - (-12.8 + 127.5j)).min() < 1e-8)
    True
    """
    model = _checked_model(case, feedback.actuator)
    delay = float(concrete(feedback.delay)) if delay is None else delay
    shapes = _sensor_shapes(case, model)
    row = np.zeros(model.state_count)
    row[model.coordinate_index] = concrete(feedback.displacement) @ shapes
    row[model.rate_index] = concrete(feedback.velocity) @ shapes
    loop = np.outer(model.command_matrix[:, feedback.actuator], row)
    if delay == 0.0:
        poles = np.linalg.eigvals(model.A + loop)
    else:
        # Rates by the highest frequency, so that all states are of one size.
        size = np.ones(model.state_count)
        size[model.rate_index] = np.sqrt(np.abs(model.A).max())
        A, loop = (matrix * size / size[:, None] for matrix in (model.A, loop))
        poles = np.array(
            [
                _refined(A, loop, delay, start[0], start[1])
                for start in _starts(A, loop, delay, 3 * count)
            ]
        )
    poles = poles[np.isfinite(poles) & (poles.imag >= 0)]
    poles = poles[np.argsort(-poles.real)]
    distinct = [i for i, s in enumerate(poles) if np.all(np.abs(poles[:i] - s) > 1e-9 * abs(s))]
    return poles[distinct][:count]


def _checked_model(case: Case, actuator: int) -> ModalModel:
    check_case(case)
    if not 0 <= actuator < len(case.actuators):
        raise ValueError(f"there is no actuator {actuator}; the case has {len(case.actuators)}")
    if not case.sensors:
        raise ValueError("there are no sensors, whose deflections the law feeds back")
    return modal_model(case)


def _sensor_shapes(case: Case, model: ModalModel) -> Float[Array, "sensor mode"]:
    """Deflections at the sensors of unit coordinates."""
    return model.shapes(case.sensor_positions, (0,))[0]


def _oscillating_modes(case: Case):
    """Open-loop poles (1/s) of positive imaginary part in ascending order, and their vectors."""
    values, vectors = np.linalg.eig(modal_model(case).A)
    order = np.argsort(values.imag)
    order = order[values[order].imag > 0]
    return values[order], vectors[:, order]


def _starts(A, loop, delay: float, wanted: int):
    """Estimates (s, z) of the rightmost poles and vectors of z' = A z + loop z(t - delay)."""
    count, states = COLLOCATION_NODES, len(A)
    nodes = np.cos(np.pi * np.arange(count + 1) / count)
    weights = np.r_[2.0, np.ones(count - 1), 2.0] * (-1.0) ** np.arange(count + 1)
    distances = nodes[:, None] - nodes + np.eye(count + 1)
    derivative = np.outer(weights, 1 / weights) / distances
    derivative -= np.diag(derivative.sum(axis=1))
    matrix = np.kron(2 / delay * derivative, np.eye(states))
    matrix[:states] = 0.0
    matrix[:states, :states] = A
    matrix[:states, -states:] = loop
    values, vectors = np.linalg.eig(matrix)
    upper = np.argsort(-values.real)
    upper = upper[values[upper].imag >= 0][:wanted]
    # Feedback may leave modes beyond the reach of the collocation nearly where they are.
    own, own_vectors = np.linalg.eig(A)
    high = own.imag * delay > count / 2
    yield from zip(values[upper], vectors[:states, upper].T, strict=True)
    yield from zip(own[high], own_vectors[:, high].T, strict=True)


def _refined(A, loop, delay: float, s: complex, vector) -> complex:
    """Pole near s of (s - A - loop exp(-s delay)) z = 0, by nonlinear inverse iteration.

    NaN if it does not converge: collocation has poles of its own far to the left.
    """
    identity = np.eye(len(A))
    for _ in range(REFINEMENTS):
        delayed = loop * np.exp(-s * delay)
        try:
            solved = np.linalg.solve(s * identity - A - delayed, vector + delay * delayed @ vector)
        except np.linalg.LinAlgError:  # singular: a pole, to rounding
            return complex(s)
        step = np.vdot(vector, vector) / np.vdot(vector, solved)
        s, vector = s - step, solved / np.linalg.norm(solved)
        if not np.abs(s) * delay < MAX_TURN:
            break
        if np.abs(step) < 1e-13 * np.abs(s):
            return complex(s)
    return complex(np.nan, np.nan)
