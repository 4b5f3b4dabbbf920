"""Frequency responses of the electrodynamic shaker on the beam of rig A: Figs 2.15 to 2.20."""

import dataclasses

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import data_physics_v4
from experiments.thesis.chapter2 import published
from experiments.thesis.verdicts import LITERAL, Experiment, ExperimentResult, make_finding
from jaxbeam.model.channels import shaker_channels
from jaxbeam.model.frequency_responses import (
    FrequencyResponse,
    frequency_response,
    resonances_and_antiresonances,
)
from jaxbeam.plot.style import colour, set_title, use_style

FREQUENCIES = np.geomspace(1.0, 1000.0, 4000)  # Hz
STATIONARY_MASS = ((0.3, 0.5),)  # m, kg: Fig. 2.16
ALUMINIUM = {"width": 0.06, "height": 3.3e-3, "youngs_modulus": 70e9, "density": 2700.0}
RIGID = {"flexural_rigidity": 1.022e5, "mass_per_length": 11.016}  # Fig. 2.20

TEXTBOOK = "aluminium of 70 GPa, 2700 kg/m^3, 3.3 mm high"  # chosen for a force drop
UNDAMPED = f"{TEXTBOOK}, without damping"
MASS_IN_IMPEDANCE = "the mass in eq. (2.26), but not in (2.33)"


def run(load_rig) -> ExperimentResult:
    """Dips and peaks of the force per voltage, the beam bare or with 0.5 kg on it."""
    printed = dataclasses.replace(load_rig("A").beam, modes=4)
    aluminium_beam = jb.Beam(
        printed.length, damping_ratio=printed.damping_ratio, modes=4, **ALUMINIUM
    )
    undamped = dataclasses.replace(aluminium_beam, damping_ratio=0.0)
    beams = {LITERAL: printed, TEXTBOOK: aluminium_beam, UNDAMPED: undamped}
    free = {name: _features(_response(beam)) for name, beam in beams.items()}
    with_mass = {name: _features(_response(beam, STATIONARY_MASS)) for name, beam in beams.items()}
    with_mass[MASS_IN_IMPEDANCE] = _features(_mass_in_impedance_only(printed))
    with_mass[f"{MASS_IN_IMPEDANCE}, beam of aluminium"] = _features(
        _mass_in_impedance_only(aluminium_beam)
    )
    transmitted = max(_peaks(_response(printed), 2), key=lambda pair: pair[1])
    one_mode = dataclasses.replace(printed, modes=1)
    null, null_with_mass = (_features(_response(one_mode, mass)) for mass in ((), STATIONARY_MASS))
    null_transmitted = max(_peaks(_response(one_mode), 2), key=lambda pair: pair[1])

    def by_beam(published_numbers, features, null_features, select):
        values = {name: select(one) for name, one in features.items()}
        first, drops_only = values.pop(LITERAL), published_numbers is published.FORCE_DROPS
        return make_finding(
            published_numbers,
            first,
            values,
            null=("one mode", select(null_features)),
            fitted=dict.fromkeys((TEXTBOOK, UNDAMPED), "2") if drops_only else None,
        )

    def drops(features):
        return np.append(features["drops"], [np.nan] * 4)[:4]

    findings = (
        by_beam(published.FORCE_DROPS, free, null, drops),
        by_beam(published.SHAKER_GAIN, free, null, lambda one: [one["low"], one["peak"][1]]),
        by_beam(published.SHAKER_PEAK_FREQUENCY, free, null, lambda one: one["peak"][0]),
        make_finding(
            published.TRANSMITTED_PEAK_FREQUENCY,
            transmitted[0],
            null=("one mode", null_transmitted[0]),
        ),
        by_beam(
            published.STATIONARY_MASS_DROP, with_mass, null_with_mass, lambda one: one["drops"][0]
        ),
        by_beam(
            published.STATIONARY_MASS_PEAK_FREQUENCY,
            with_mass,
            null_with_mass,
            lambda one: one["peak"][0],
        ),
        by_beam(
            published.STATIONARY_MASS_PEAK, with_mass, null_with_mass, lambda one: one["peak"][1]
        ),
    )
    stiff = dataclasses.replace(printed, **{key: np.asarray(value) for key, value in RIGID.items()})
    return ExperimentResult(findings, {"responses": _draw(printed, stiff)})


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
    panels[0, 0].legend(["free beam", "0.5 kg at 0.3 m"], loc="lower left")
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
