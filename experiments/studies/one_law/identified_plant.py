"""Plant parameters that the law for all rigs needs, identified by a probe without a load.

    python -m experiments.studies.one_law.identified_plant

A pseudorandom command of 0 or 1 V for 1.5 s on the unloaded one-span rig; from the reading follow
the share of the patch's moment that reaches the beam, hence the lift, and the cutoff of the filter
(`tuning.identify`), and the delay as the one of least residual. Before, the commands are within the
probe. The law designed for these numbers then meets the held-out loads on the true plant.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.held_out import PERIOD, held_out_loads
from experiments.studies.one_law.plants import ONE_LAW, Shares, plant_case
from jaxbeam.model.modes import mesh_layout
from tuning.control.objective import with_fixed_design

CORRECTION, CUTOFF = "actuators.0.correction", "sensors.0.filter.cutoff"
FREE = {CORRECTION: (0.1, 0.6), CUTOFF: (3.0, 45.0)}
GUESS = {CORRECTION: 0.4, CUTOFF: 20.0}
DELAYS = (0.0, 0.01, 0.02, 0.03, 0.04)  # s
PROBE, PROBE_SAMPLES, SAMPLES_PER_BIT = 1.0, 150, 4  # V
TRUTH = {"cutoff": 7.0, "delay": 0.03, "factor": 1.0}  # Hz, s
TRUE_CORRECTION = 0.27


def probed(case: jb.Case, delay: float) -> jb.Case:
    """The case without a load under the probe, with a delay (s)."""
    rng = np.random.default_rng(0)
    bits = np.repeat(rng.integers(0, 2, PROBE_SAMPLES), SAMPLES_PER_BIT)[:PROBE_SAMPLES]
    bits[:SAMPLES_PER_BIT] = 0
    times = PERIOD * np.arange(PROBE_SAMPLES)
    controller = jb.Prescribed(
        offsets=[0.0], times=times, values=[PROBE * bits], period=PERIOD, delay=delay
    )
    run = jb.Run(PROBE_SAMPLES * PERIOD, sample_rate=1 / PERIOD)
    return dataclasses.replace(case, loads=(), controller=controller, run=run)


def identified(case: jb.Case, log: tuning.Log) -> tuple[dict[str, float], float]:
    """Numbers of the plant by address, and the delay (s), from a log of the probe."""
    fits = {
        delay: tuning.identify(probed(jb.replace(case, GUESS), delay), log, FREE)
        for delay in DELAYS
    }
    delay = min(fits, key=lambda one: float(np.nansum(np.square(fits[one].residuals))))
    fit = fits[delay]
    return dict(zip(fit.addresses, map(float, fit.values), strict=True)), delay


def main() -> None:
    """Print true and identified numbers, and the shares of the law with either."""
    true = jb.replace(plant_case("B", ONE_LAW, **TRUTH), {CORRECTION: TRUE_CORRECTION})
    record = jb.simulate(probed(true, TRUTH["delay"]))
    readings = np.asarray(record.measured)
    log = tuning.Log(
        np.asarray(record.times), readings, ("w",), ("deflection",), ("m",), sensors=(0,), loads=()
    )
    values, delay = identified(true, log)
    print(f"true: {TRUE_CORRECTION:g}, {TRUTH['cutoff']:g} Hz, {1e3 * TRUTH['delay']:g} ms")
    print(f"identified: {values[CORRECTION]:.3f}, {values[CUTOFF]:.2f} Hz, {1e3 * delay:g} ms")
    for name, case in (
        ("true numbers", true),
        ("identified numbers", with_fixed_design(true, values, mesh_layout(true))),
    ):
        found = Shares()("B", case, held_out_loads("B"))
        print(f"law with {name}: at worst {found.min():.1%}, {found.mean():.1%} in the mean")


if __name__ == "__main__":
    main()
