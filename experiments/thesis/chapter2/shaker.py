"""Frequency responses of the electrodynamic shaker on the beam of rig A: Figs 2.15 to 2.20."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy.optimize
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import data_physics_v4
from experiments.thesis.chapter2 import published
from experiments.thesis.chapter2.patches import DENSITY, MODULUS
from experiments.thesis.verdicts import LITERAL, Experiment, ExperimentResult, make_finding
from jaxbeam.model.frequency_responses import (
    FrequencyResponse,
    frequency_response,
    resonances_and_antiresonances,
    shaker_channels,
)
from jaxbeam.plot.style import colour, set_title, use_style

FREQUENCIES = np.geomspace(1.0, 1000.0, 4000)  # Hz
STATIONARY_MASS = ((0.3, 0.5),)  # m, kg: Fig. 2.16
ALUMINIUM = {"width": 0.06, "height": 3.3e-3, "youngs_modulus": 70e9, "density": 2700.0}
RIGID = {"flexural_rigidity": 1.022e5, "mass_per_length": 11.016}  # Fig. 2.20

TEXTBOOK = "aluminium of 70 GPa, 2700 kg/m^3, 3.3 mm high"  # chosen for a force drop
UNDAMPED = f"{TEXTBOOK}, without damping"
DENSER = "2800 kg/m^3, as the patch rigs"  # chosen for the critical speed
MASS_IN_IMPEDANCE = "the mass in eq. (2.26), but not in (2.33)"
IDENTIFIED = "rigidity and mass per length fitted to Fig. 2.15"
MISSING = 100.0  # standard deviations by which a lacking number is off
UNKNOWN = ("flexural_rigidity", "mass_per_length")
# Numbers of Fig. 2.15, and the standard deviations by rounding: half a unit of the last digit.
OF_FREE_BEAM = published.FORCE_DROPS, published.SHAKER_GAIN, published.SHAKER_PEAK_FREQUENCY
OF_MASS = (
    published.STATIONARY_MASS_DROP,
    published.STATIONARY_MASS_PEAK_FREQUENCY,
    published.STATIONARY_MASS_PEAK,
)


class IdentifiedBeam(NamedTuple):
    """Rigidity (N m^2) and mass per length (kg/m) of a beam, fitted to printed numbers.

    `covariance` is that of both by rounding, `predicted` the numbers of Fig. 2.16 with a mass and
    `deviations` their standard deviations.
    """

    values: np.ndarray
    covariance: np.ndarray
    predicted: np.ndarray
    deviations: np.ndarray


def identified_beam(printed: jb.Beam, jointly: bool = False) -> IdentifiedBeam:
    """Beam whose rigidity and mass per length are fitted to Fig. 2.15, or to Fig. 2.16 `jointly`.

    By least squares of all printed numbers over half a unit of their last digits. The damping is
    the printed one, and the mass of Fig. 2.16 is in eq. (2.26) alone.
    """
    parts = OF_FREE_BEAM + (OF_MASS if jointly else ())
    numbers = np.concatenate([one.numbers for one in parts])
    scatter = np.concatenate([one.allowed_error for one in parts]) / 2
    start = np.array([getattr(printed, name) for name in UNKNOWN], float)

    def beam(scales) -> jb.Beam:
        return dataclasses.replace(printed, **dict(zip(UNKNOWN, scales * start, strict=True)))

    def predictions(scales):
        return _of_mass(_features(_mass_in_impedance_only(beam(scales))))

    def residuals(scales):
        found = _of_free_beam(_features(_response(beam(scales))))
        found = np.concatenate([found, predictions(scales)]) if jointly else found
        off = (found - numbers) / scatter
        return np.where(np.isfinite(off), off, MISSING)  # a drop that is not there

    fit = scipy.optimize.least_squares(residuals, np.ones(2), diff_step=1e-3, x_scale=0.01)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    steps = 1e-3 * np.eye(2)
    slopes = [(predictions(fit.x + one) - predictions(fit.x - one)) / 2e-3 for one in steps]
    deviations = np.sqrt(np.einsum("in,ij,jn->n", slopes, covariance, slopes))
    return IdentifiedBeam(
        fit.x * start, covariance * np.outer(start, start), predictions(fit.x), deviations
    )


def _of_free_beam(features: dict) -> np.ndarray:
    """Numbers of Fig. 2.15 in the order of OF_FREE_BEAM."""
    drops = np.append(features["drops"], [np.nan] * 4)[:4]
    frequency, height = features["peak"]
    return np.concatenate([drops, [features["low"], height, frequency]])


def _of_mass(features: dict) -> np.ndarray:
    """Numbers of Fig. 2.16 in the order of OF_MASS."""
    return np.array([features["drops"][0], *features["peak"]])


def beams_of_rig_a(printed: jb.Beam) -> dict[str, jb.Beam]:
    """The beam of rig A by each answer to what it is made of, with the modes of the printed one.

    A height of 3.3 mm and 65 GPa give the printed 11.68 N m^2, and with the density of the patch
    rigs 0.554 kg/m instead of the printed 0.535.
    """
    aluminium = jb.Beam(
        printed.length, damping_ratio=printed.damping_ratio, modes=printed.modes, **ALUMINIUM
    )
    section = jb.Beam(
        printed.length, width=0.06, height=3.3e-3, youngs_modulus=MODULUS, density=DENSITY
    )
    found = identified_beam(dataclasses.replace(printed, modes=4)).values
    return {
        LITERAL: printed,
        TEXTBOOK: aluminium,
        UNDAMPED: dataclasses.replace(aluminium, damping_ratio=0.0),
        DENSER: dataclasses.replace(printed, mass_per_length=section.linear_density),
        IDENTIFIED: dataclasses.replace(printed, **dict(zip(UNKNOWN, found, strict=True))),
    }


def run(load_rig) -> ExperimentResult:
    """Dips and peaks of the force per voltage, the beam bare or with 0.5 kg on it."""
    printed = dataclasses.replace(load_rig("A").beam, modes=4)
    found, joint = identified_beam(printed), identified_beam(printed, jointly=True)
    beams = beams_of_rig_a(printed)
    free = {name: _response(beam) for name, beam in beams.items()}
    with_mass: dict[str | tuple[str, ...], FrequencyResponse] = {
        name: _response(beam, STATIONARY_MASS) for name, beam in beams.items()
    }
    with_mass |= {
        (MASS_IN_IMPEDANCE,) if name == LITERAL else (name, MASS_IN_IMPEDANCE): (
            _mass_in_impedance_only(beam)
        )
        for name, beam in beams.items()
    }
    one_mode = dataclasses.replace(printed, modes=1)
    free_null, null_with_mass = (_response(one_mode, mass) for mass in ((), STATIONARY_MASS))

    def by_reading(published_numbers, responses, null, select, remark=""):
        values = {name: select(one) for name, one in responses.items()}
        first, drops_only = values.pop(LITERAL), published_numbers is published.FORCE_DROPS
        by_section = dict.fromkeys((TEXTBOOK, UNDAMPED), "2") if drops_only else {}
        to_figure = (
            {IDENTIFIED: published_numbers.labels} if published_numbers in OF_FREE_BEAM else {}
        )
        return make_finding(
            published_numbers,
            first,
            values,
            null=("one mode", select(null)),
            fitted=by_section | to_figure,
            parameters={IDENTIFIED: len(UNKNOWN) if drops_only else 0},
            remark=remark,
        )

    def of_free(start, stop=None):
        return lambda response: _of_free_beam(_features(response))[start:stop]

    def of_mass(index):
        return lambda response: _of_mass(_features(response))[index]

    remark = (
        f"Fig. 2.15 gives {found.predicted[2]:.1f} +- {2 * found.deviations[2]:.1f} for it; fitted"
        f" to both figures, {joint.predicted[2]:.1f}"
    )
    findings = (
        by_reading(published.FORCE_DROPS, free, free_null, of_free(0, 4)),
        by_reading(published.SHAKER_GAIN, free, free_null, of_free(4, 6)),
        by_reading(published.SHAKER_PEAK_FREQUENCY, free, free_null, of_free(6)),
        by_reading(
            published.TRANSMITTED_PEAK_FREQUENCY,
            free,
            free_null,
            lambda response: max(_peaks(response, 2), key=lambda pair: pair[1])[0],
        ),
        by_reading(published.STATIONARY_MASS_DROP, with_mass, null_with_mass, of_mass(0)),
        by_reading(published.STATIONARY_MASS_PEAK_FREQUENCY, with_mass, null_with_mass, of_mass(1)),
        by_reading(published.STATIONARY_MASS_PEAK, with_mass, null_with_mass, of_mass(2), remark),
    )
    stiff = dataclasses.replace(printed, **{key: np.asarray(value) for key, value in RIGID.items()})
    remarks = tuple(
        f"{what}: rigidity {values[0]:.2f} +- {2 * deviation[0]:.2f} N m^2, mass per length"
        f" {values[1]:.4f} +- {2 * deviation[1]:.4f} kg/m (95 %, by the rounding of the numbers)."
        for what, values, deviation in (
            ("Fitted to Fig. 2.15", found.values, np.sqrt(np.diag(found.covariance))),
            ("Fitted to Figs 2.15 and 2.16", joint.values, np.sqrt(np.diag(joint.covariance))),
        )
    )
    return ExperimentResult(findings, {"responses": _draw(printed, stiff)}, remarks)


def _response(beam: jb.Beam, stationary_masses=()) -> FrequencyResponse:
    case = jb.Case(beam, actuators=[data_physics_v4()])
    return frequency_response(case, FREQUENCIES, shaker_channels(0), stationary_masses)


def _mass_in_impedance_only(beam: jb.Beam) -> FrequencyResponse:
    """Response with the stationary mass in the coil's impedance, eq. (2.26), but not in eq. (2.33).

    Both contain the accelerance of the beam, and eq. (2.30) with the mass is written for one.
    """
    bare, with_mass = _response(beam).values, _response(beam, STATIONARY_MASS)
    values = np.array(with_mass.values)
    values[:, 3] = values[:, 3] / values[:, 2] * bare[:, 2]
    return eqx.tree_at(lambda response: response.values, with_mass, values)


def _peaks(response: FrequencyResponse, pair: int) -> list[tuple[float, float]]:
    """Peaks of one input-output pair of a response: frequency (Hz) and magnitude."""
    return [
        (at, magnitude)
        for kind, at, magnitude in resonances_and_antiresonances(response, pair)
        if kind == "peak"
    ]


def _features(response: FrequencyResponse) -> dict:
    """Features of the force per voltage.

    "low": its value at the lowest frequency (N/V), "drops": dips below that (Hz), "peak": the
    largest peak (Hz, N/V).
    """
    extrema = resonances_and_antiresonances(response, 3)
    low = extrema[0][2]
    drops = [at for kind, at, magnitude in extrema if kind == "dip" and magnitude < low]
    return {
        "low": low,
        "drops": drops,
        "peak": max(_peaks(response, 3), key=lambda pair: pair[1]),
    }


@use_style
def _draw(beam, stiff) -> Figure:
    """Magnitudes from voltage to force on the beam, with the axes of Figs 2.15 to 2.18, 2.20."""
    figure = Figure(figsize=(7.2, 5.6))
    panels = figure.subplots(2, 2, sharex=True)
    free, with_mass, rigid = _response(beam), _response(beam, STATIONARY_MASS), _response(stiff)
    lines = (
        ("force per voltage (N/V), Figs 2.15, 2.16", 3, np.abs, (free, with_mass)),
        (
            "impedance (\N{GREEK CAPITAL LETTER OMEGA}), Fig. 2.17",
            0,
            lambda h: 1 / np.abs(h),
            (free, with_mass),
        ),
        ("force on the beam per coil force, Fig. 2.18", 2, np.abs, (free, with_mass)),
        ("force per voltage (N/V), rigid beam, Fig. 2.20", 3, np.abs, (rigid,)),
    )
    for axes, (title, pair, size, found) in zip(panels.flat, lines, strict=True):
        for i, response in enumerate(found):
            values = size(np.asarray(response.values)[:, pair])
            axes.loglog(FREQUENCIES, values, ("-", "--")[i], color=colour(i))
        axes.set_title(title)
        axes.set_xlim(FREQUENCIES[0], FREQUENCIES[-1])
    lag = 4.6 / np.sqrt(1 + (FREQUENCIES / (1e4 / (2 * np.pi))) ** 2)
    panels[1, 1].loglog(
        FREQUENCIES, lag, ":", color=colour(2), label="first-order shaker, Fig. 2.19"
    )
    panels[1, 1].set_ylim(1, 10)
    panels[1, 1].legend(loc="lower left")
    panels[0, 0].legend(["free beam", "0.5 kg at 0.3 m"], loc="upper right")
    for axes in panels[-1]:
        axes.set_xlabel("frequency (Hz)")
    set_title(figure, "Electrodynamic shaker on the beam of rig A")
    return figure


EXPERIMENT = Experiment(
    "shaker",
    "Figs 2.15 to 2.20",
    "The force of the shaker drops at the resonances of the beam and peaks between; below 10 Hz it"
    " is proportional to the voltage.",
    run,
)
