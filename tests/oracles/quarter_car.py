"""A quarter car on a profile across a simply supported span, by scipy; see `modal_equations`.

With the deflection under the wheel and the profile, y = w + r, the coupled equations are

    q'' + 2 Z W q' + W^2 q = -F phi(x),    F = (m_b + m_a) g + k_t (y - a) + c_t (y' - a'),
    m_a a'' = k_t (y - a) + c_t (y' - a') - f,    m_b b'' = f = k_s (a - b) + c_s (a' - b'),

with y' = w_t + x' (w_x + r') and the heights a, b of axle and body from static equilibrium.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.loads import GRAVITY
from tests.oracles.modal_equations import Span


@dataclass(frozen=True)
class Car:
    """Masses (kg), springs (N/m) and dampers (N s/m) of a quarter car."""

    body_mass: float
    axle_mass: float
    suspension_stiffness: float
    suspension_damping: float
    tyre_stiffness: float
    tyre_damping: float


def cross(span: Span, car: Car, motion, profile, events, times):
    """States (time, ...) at times (s): modal coordinates and rates, heights, their rates; forces.

    `motion(t)` is position, speed of the wheel; `profile(x)` height and slope. The solver starts
    anew at each of the `events` (s), where a number jumps. At rest in static equilibrium at first.
    """
    modes = span.modes
    x, _ = motion(times[0])
    height = profile(x)[0]

    def surface(t, z):
        x, speed = motion(t)
        r, slope = profile(x)
        on_beam = 0.0 <= x <= span.length
        shape = span.shapes(x) if on_beam else np.zeros(modes)
        gradient = span.shapes(x, 1) if on_beam else np.zeros(modes)
        q, rate = z[:modes], z[modes : 2 * modes]
        return shape, shape @ q + r, shape @ rate + speed * (gradient @ q + slope)

    def tyre(t, z):
        shape, y, y_rate = surface(t, z)
        a, a_rate = z[2 * modes + 1], z[2 * modes + 3]
        return shape, car.tyre_stiffness * (y - a) + car.tyre_damping * (y_rate - a_rate)

    def rates(t, z):
        shape, pressed = tyre(t, z)
        q, rate = z[:modes], z[modes : 2 * modes]
        b, a, b_rate, a_rate = z[2 * modes :]
        lift = car.suspension_stiffness * (a - b) + car.suspension_damping * (a_rate - b_rate)
        force = (car.body_mass + car.axle_mass) * GRAVITY + pressed
        acceleration = -force * shape - span.damping @ rate - span.frequencies**2 * q
        heights = lift / car.body_mass, (pressed - lift) / car.axle_mass
        return np.concatenate([rate, acceleration, [b_rate, a_rate], heights])

    state = np.concatenate([np.zeros(2 * modes), [height, height, 0.0, 0.0]])
    ends = np.unique(np.clip([times[0], *events, times[-1]], times[0], times[-1]))
    states = np.zeros((len(times), state.size))
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        # Just inside, so that the wheel is on the same piece of the profile all along.
        inside = (times >= start) & (times <= end)
        wanted = np.unique(np.append(times[inside], end))
        middle = (start + end) / 2
        solution = solve_ivp(
            lambda t, z, middle=middle: rates(t + 1e-13 * (middle - t), z),
            (start, end),
            state,
            method="DOP853",
            t_eval=wanted,
            rtol=1e-12,
            atol=1e-16,
        )
        assert solution.success, solution.message
        states[inside] = solution.y[:, np.isin(wanted, times[inside])].T
        state = solution.y[:, -1]
    weight = (car.body_mass + car.axle_mass) * GRAVITY
    forces = np.array([weight + tyre(t, z)[1] for t, z in zip(times, states, strict=True)])
    return states, forces
