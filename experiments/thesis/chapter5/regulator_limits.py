"""Sampled gains and stability of the regulators of section 5.

Frozen poles are no stability criterion for a time-varying loop; the thesis publishes them as one.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure, SubFigure

import jaxbeam as jb
from experiments.thesis.cases import with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.analysis.stability import Growth, frozen_poles, growth, stability_limit
from jaxbeam.control.sampled_lqr import sampling_limit
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.plot.modes import plot_poles

COMMAND_WEIGHT = 9e-8  # R of the example in 5.1
ACTIVE_STIFFNESS = 3500.0  # N/m
TWO_MODE_STATES = (0, 1, 3, 4, 6)  # of the seven states of three modes
OTHER_SHAKER = "4.6 N/V over root two, alpha = beta = 1000, section of 60 mm by 3.3 mm"
OTHER_FORCE = 4.6 / np.sqrt(2)  # N/V
OTHER_SECTION = {"width": 0.06, "height": 3.3e-3, "youngs_modulus": 65e9, "density": 2700.0}
# Shakers for all of which the printed gain of 0.2 ms is tried: N/V, rad/s, N/m.
SHAKER_GRID = (1.0, 2.5, 4.6, 10.0), (500.0, 1e3, 1e4, 2e4), (0.0, 3500.0, 12000.0, 3e4)
SPEEDS = (0.55, 5.6)  # m/s, that of the experiments and that of Fig. 5.18
MASSES = (0.509, 6.5)  # kg
LOAD_POSITIONS = 201  # along the crossing: real parts have a narrow peak near the exit


def with_active_shaker(rig: jb.Case) -> jb.Case:
    """The rig with the suspension stiffness of its driven shaker."""
    return jb.replace(rig, {"actuators.0.stiffness": ACTIVE_STIFFNESS})


def with_other_shaker(rig: jb.Case) -> jb.Case:
    """The rig with a shaker for which the printed gains of the sampled regulator are optimal.

    Its force per volt and its bandwidth were fitted to the twelve gains for 5 and 10 ms: they are
    4.6 N/V over the root of two, to five digits, and a tenth of the printed 10000 rad/s. The beam
    has the rigidity and density of its section before rounding, 11.6795 N m^2 and 0.5346 kg/m.
    """
    section = jb.Beam(float(rig.beam.length), **OTHER_SECTION)
    return jb.replace(
        rig,
        {
            "actuators.0.force_per_volt": OTHER_FORCE,
            "actuators.0.bandwidth": 1000.0,
            "beam.flexural_rigidity": float(section.bending_stiffness),
            "beam.mass_per_length": float(section.linear_density),
        },
    )


def sampling_findings(rig: jb.Case, weights) -> list[Finding]:
    """Sampling limits and gains of the sampled regulator, for the rig with its shaker."""
    rig = with_active_shaker(rig)
    moved_shaker = jb.replace(rig, {"actuators.0.position": 0.25})
    moved_shaker = with_modes(moved_shaker, 2)
    two_mode_weights = [weights[i] for i in TWO_MODE_STATES]
    gains = (
        (published.SAMPLED_GAIN, rig, 5e-3, weights),
        (published.MOVED_SHAKER_GAIN, moved_shaker, 1e-2, two_mode_weights),
        (published.FAST_GAIN, rig, 2e-4, weights),
    )
    bare = sampling_limit(dataclasses.replace(rig, actuators=()))
    limits = make_finding(
        published.SAMPLING_LIMITS, sampling_limit(rig), null=("beam without shaker", bare)
    )
    return [limits, *(_gain_finding(printed, *problem) for printed, *problem in gains)]


def optimal_gain(case, period: float, weights, command_weight: float = COMMAND_WEIGHT):
    """Optimal gain (command, state) of the sampled regulator, and its cost matrix (state, state).

    States are those of the thesis: amplitudes of sine modes, their rates, and the shaker.
    """
    plant = jb.state_space(case, "sine").unloaded.discretize(period)
    return dlqr(plant.A, plant.B, np.diag(weights), command_weight * np.eye(1))


def _gain_finding(numbers, case, period, weights) -> Finding:
    """A printed gain beside the optimal one; inconsistent if no shaker is stable under it."""
    best, other = (
        np.asarray(optimal_gain(one, period, weights)[0])[0]
        for one in (case, with_other_shaker(case))
    )
    fitted = {OTHER_SHAKER: "q1 q2"} if numbers is published.SAMPLED_GAIN else None
    return make_finding(
        numbers,
        best,
        {OTHER_SHAKER: other},
        null=("no control", 0.0),
        fitted=fitted,
        inconsistent=_instability(case, period, numbers.numbers),
    )


def _instability(case: jb.Case, period: float, gain: np.ndarray) -> str:
    """Sentence why no shaker has a printed gain as its optimum: all loops are unstable; or empty.

    An optimal gain stabilises the loop that it is designed for.
    """
    growth_per_period = []
    for force, bandwidth, stiffness in itertools.product(*SHAKER_GRID):
        shaker = {
            "actuators.0.force_per_volt": force,
            "actuators.0.bandwidth": bandwidth,
            "actuators.0.stiffness": stiffness,
        }
        plant = jb.state_space(jb.replace(case, shaker), "sine").unloaded.discretize(period)
        closed = np.asarray(plant.A) - np.asarray(plant.B) @ gain[None]
        growth_per_period.append(np.abs(np.linalg.eigvals(closed)).max())
    if min(growth_per_period) < 1:
        return ""
    forces, bandwidths, stiffnesses = SHAKER_GRID
    return (
        "an optimal gain stabilises the loop that it is designed for, and under the printed one"
        f" deviations grow to at least {min(growth_per_period):.2g} times in each period, for all"
        f" {len(growth_per_period)} shakers tried, {forces[0]:g} to {forces[-1]:g} N/V,"
        f" {bandwidths[0]:g} to {bandwidths[-1]:g} rad/s and {stiffnesses[0]:g} to"
        f" {stiffnesses[-1]:g} N/m"
    )


@dataclasses.dataclass(frozen=True, eq=False)
class TimeVaryingLoops:
    """The time-varying loop with few states fed back, and with all."""

    partial_feedback: jb.Case
    full_feedback: jb.Case
    _known: dict[tuple[float, float], float] = dataclasses.field(default_factory=dict, init=False)

    def at_speed(self, speed: float) -> jb.Case:
        """The loop with few states, crossed by the first mass at a speed (m/s)."""
        changes = {"loads.0.speed": speed, "loads.0.mass": MASSES[0]}
        return jb.replace(self.partial_feedback, changes)

    @functools.cache  # noqa: B019 (few loops, all of which live as long as the experiment)
    def growth(self, speed: float) -> Growth:
        """Growth of deviations in `at_speed`, computed once for each speed (m/s)."""
        return growth(self.at_speed(speed))

    def largest_real_part(self, case: jb.Case) -> float:
        """`largest_real_part` of the loop with few states, once for each speed and mass."""
        load = case.loads[0]
        key = float(load.speed), float(load.mass)
        if key not in self._known:
            self._known[key] = largest_real_part(case)
        return self._known[key]


def frozen_pole_findings(interpretations: Mapping[str, TimeVaryingLoops]) -> list[Finding]:
    """Stability by frozen poles, of loops by interpretation."""
    unstable, limits = {}, {}
    for name, loops in interpretations.items():
        slow, fast = ({"loads.0.speed": speed, "loads.0.mass": MASSES[0]} for speed in SPEEDS)
        partial = jb.replace(loops.partial_feedback, slow)
        rates = [
            loops.largest_real_part(partial),
            loops.largest_real_part(jb.replace(partial, fast)),
            largest_real_part(jb.replace(loops.full_feedback, fast)),
        ]
        unstable[name] = np.array(rates) > 0
        searches = ("loads.0.speed", SPEEDS), ("loads.0.mass", MASSES)
        limits[name] = np.array(
            [
                _stability_limit(partial, address, bounds, loops.largest_real_part)
                for address, bounds in searches
            ]
        )
    literal, *others = interpretations
    answers = {tuple(name.split("; ")): name for name in others}
    return [
        make_finding(
            published.UNSTABLE_FROZEN_POLES,
            unstable[literal].astype(float),
            {key: unstable[name].astype(float) for key, name in answers.items()},
            null=("no control, stable everywhere", 0.0),
        ),
        make_finding(
            published.FROZEN_POLE_LIMITS,
            limits[literal],
            {key: limits[name] for key, name in answers.items()},
            null=("no control, stable everywhere", np.inf),
        ),
    ]


def growth_remark(interpretations: Mapping[str, TimeVaryingLoops]) -> str:
    """Sentence on growth of deviations in loops with few states, invisible to frozen poles."""
    parts = []
    for name, loops in interpretations.items():
        for speed in SPEEDS:
            rate = loops.largest_real_part(loops.at_speed(speed))
            factors = loops.growth(speed).factor
            parts.append(
                f"{name}, {speed:g} m/s: frozen poles up to {rate:+.2g} 1/s,"
                f" deviations grow to at most {factors.max():.3g} times, {factors[-1]:.1g} at the"
                " exit"
            )
    return "Few states, 0.509 kg. " + "; ".join(parts)


def draw_poles(loops: TimeVaryingLoops, interpretation: str) -> Figure | SubFigure:
    """Fig. 5.18, few states: frozen poles along a crossing, and the growth of deviations.

    The last twentieth of the crossing is left out: there the pole of the shaker's lag moves far
    into the left half-plane.
    """
    case = loops.at_speed(SPEEDS[1])
    times = np.linspace(0.0, 0.95 * float(case.beam.length) / SPEEDS[1], LOAD_POSITIONS)
    return plot_poles(
        frozen_poles(case, times),
        loops.growth(SPEEDS[1]),
        f"Few states, {SPEEDS[1]:g} m/s; {interpretation}",
    )


def largest_real_part(case: jb.Case) -> float:
    """The largest real part (1/s) of the frozen poles over the crossing, those of A - B K."""
    law, plant = case.controller, jb.state_space(case, "sine")
    shares = np.linspace(0.0, 1.0, LOAD_POSITIONS)[1:-1]
    table = law.gain_table(law.design.design_plant(plant, "sine"))
    gains = np.stack([np.asarray(table(share)) for share in shares]) * law.feedback_fractions
    systems = plant.at(shares * float(case.beam.length / case.loads[0].speed))
    command_columns = np.asarray(systems.B)[..., : gains.shape[1]]  # loads follow
    poles = np.linalg.eigvals(np.asarray(systems.A) - command_columns @ gains)
    return float(poles.real.max())


def _stability_limit(case, address, bounds, rate) -> float:
    """Value of a number from which the loop is unstable; the lower bound if it is unstable there.

    `rate` returns the largest real part (1/s) of a case.
    """
    if rate(jb.replace(case, {address: bounds[0]})) > 0:
        return bounds[0]
    limit = stability_limit(case, address, bounds[0], bounds[1], rate, points=5)
    return np.inf if limit is None else limit
