"""Finite-element rigs, their readings, and fits of models to these readings.

The plant is a finite-element beam with its first modes, integrated by scipy; the model fitted to
its readings has as many modes, or fewer.
"""

import dataclasses

import numpy as np
import scipy.signal

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.oracles import crossing, finite_elements
from tests.oracles.crossing import Load
from tuning import Fit, Log
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares, t_quantile
from tuning.fit.result import fit_result
from tuning.parameters import free_parameters, to_unbounded

RATE, MEMORY = 100.0, 0.5  # Hz, correlation from sample to sample
NOISE = {"deflection": 1e-5, "acceleration": 2e-3}  # m, m/s^2
UNITS = {"deflection": "m", "acceleration": "m/s^2"}
# N/m: under 0.5 kg the supports deflect by half the noise, and by twelve times the noise.
YIELDING, SAGGING = 1e6, 4e4
MOMENT, AMPLIFIER = 8.292e-4, 200.0  # N m/V
SHAKER = {"position": 0.5, "stiffness": 3500.0, "damping": 80.0, "force_per_volt": 4.6}
FITTED = {
    jb.Patch: ("correction",),
    jb.Shaker: tuple(SHAKER)[1:],
    jb.SpringDamper: ("stiffness", "damping"),
}


@dataclasses.dataclass(frozen=True)
class Plant:
    """A rig as finite elements, its load and commands, and the case with the true numbers."""

    beam: finite_elements.Beam
    case: jb.Case
    truth: dict[str, float]
    modes: int = 12

    def readings(self, times, commands, loaded=True):
        """Readings (time, sensor); commands (time, actuator) are linear between samples."""
        model = finite_elements.assemble(self.beam)
        rows = [self._row(model, actuator) for actuator in self.case.driven]

        def force(t):
            columns = zip(rows, commands.T, strict=True)
            return sum(
                row * np.interp(t - delay, times, column) for (row, delay), column in columns
            )

        loads = self.case.loads if loaded else ()
        run = crossing.respond(
            self.beam,
            [Load(float(a.mass), float(a.speed), float(a.entry_time)) for a in loads],
            [float(sensor.position) for sensor in self.case.sensors],
            times,
            modes=self.modes,
            force=force,
            rtol=1e-7,
            atol=1e-10,
        )
        columns = [getattr(run, s.quantity)[:, i] for i, s in enumerate(self.case.sensors)]
        return np.stack(columns, axis=1)

    def _row(self, model, actuator):
        """Nodal forces per volt, and their delay (s): a pure delay in place of a lag."""
        if isinstance(actuator, jb.Shaker):
            return float(actuator.force_per_volt) * model.shape(
                float(actuator.position)
            ), 1 / float(actuator.bandwidth)
        moment = MOMENT * float(actuator.correction) * AMPLIFIER
        return moment * model.patch_row(float(actuator.start), float(actuator.end)), 0.0


def patch(start: float, correction: float) -> jb.Patch:
    return jb.Patch(
        start,
        start + 0.085,
        moment_per_volt=MOMENT,
        correction=correction,
        amplifier_gain=AMPLIFIER,
    )


def plant(
    spans, rigidity, density, actuators, suspensions, supports, sensors, modes, ends=None
) -> Plant:
    """A beam over spans of 0.6 m, crossed by 0.5 kg at 2 m/s."""
    length, damping = 0.6 * spans, 0.03
    ends = ends or ("free-free" if spans == 1 else "pinned-pinned")
    beam = finite_elements.Beam(
        length,
        rigidity,
        density,
        ends=ends,
        supports=[finite_elements.Support(*support) for support in supports.items()],
        suspensions=suspensions,
        damping_ratio=damping,
        elements=24 * spans,
    )
    case = jb.Case(
        jb.Beam(
            length=length,
            flexural_rigidity=rigidity,
            mass_per_length=density,
            damping_ratio=damping,
            ends=ends,
            modes=modes,
        ),
        supports=[jb.Support(x, stiffness=stiffness) for x, stiffness in supports.items()],
        actuators=actuators,
        sensors=[jb.Sensor(*sensor) for sensor in sensors],
        loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.02)],
    )
    truth = {
        "beam.flexural_rigidity": rigidity,
        "beam.mass_per_length": density,
        "beam.damping_ratio": damping,
    }
    for i, stiffness in enumerate(supports.values()):
        truth |= {f"supports.{i}.stiffness": stiffness} if stiffness == SAGGING else {}
    for i, actuator in enumerate(actuators):
        names = FITTED[type(actuator)]
        truth |= {f"actuators.{i}.{name}": float(getattr(actuator, name)) for name in names}
    return Plant(beam, case, truth)


def autocorrelated(shape, seed):
    """First-order autoregressive noise (time, sensor) of standard deviation one."""
    white = np.random.default_rng(seed).normal(size=shape)
    filtered = scipy.signal.lfilter([np.sqrt(1 - MEMORY**2)], [1, -MEMORY], white, axis=0)
    return np.asarray(filtered)


class SimulatedIdentification:
    """Readings of a plant, and one compiled least-squares problem in all its parameters."""

    def __init__(self, rig: Plant):
        self.truth, count = rig.truth, len(rig.case.driven)
        times = np.arange(round(0.8 * RATE)) / RATE
        phases = 90.0 * np.arange(count)
        commands = np.stack(
            [2.0 * scipy.signal.chirp(times, 2.0, times[-1], 30.0, phi=phi) for phi in phases], 1
        )
        self.clean = rig.readings(times, commands)
        quantities = tuple(sensor.quantity for sensor in rig.case.sensors)
        self.noise = np.array([NOISE[quantity] for quantity in quantities])
        sensors = len(quantities)
        log = Log(
            times,
            np.column_stack([self.clean, commands]),
            tuple(f"c{i}" for i in range(sensors + count)),
            quantities + ("voltage",) * count,
            tuple(UNITS[quantity] for quantity in quantities) + ("V",) * count,
            actuators=(None,) * sensors + tuple(range(count)),
        )
        start = {address: 1.06 * value for address, value in rig.truth.items()}
        dataset = make_dataset(replace(rig.case, start), [log])
        scale = np.ptp(self.clean)
        self.parameters = free_parameters(dataset.cases, dict.fromkeys(rig.truth), scale)
        self.least_squares = LeastSquares(dataset, self.parameters)
        self.true_point = to_unbounded(self.parameters, rig.truth.values())

    def fit(self, noise, free, fixed_values=None):
        """Solution for the free parameters, others fixed (at the truth if left out); unit noise."""
        measured = (self.clean + self.noise * noise)[None]
        fixed_values = self.true_point if fixed_values is None else fixed_values
        start = np.where(free, self.least_squares.start_point, fixed_values)
        return self.least_squares.solve(measured, start=start, free=free)

    def errors(self, solution, free):
        """Errors of the free parameters, in half widths of the stated intervals."""
        half_widths = t_quantile(solution.degrees_of_freedom) * solution.uncertainty.errors[free]
        return (solution.values[free] - np.array(list(self.truth.values()))[free]) / half_widths

    def result(self, noise, solution) -> Fit:
        """The fit of a solution."""
        dataset = self.least_squares.data
        fit = fit_result(dataset.cases[0], self.least_squares, solution)
        noisy = dataclasses.replace(dataset, measured=(self.clean + self.noise * noise)[None])
        return dataclasses.replace(fit, dataset=noisy)
