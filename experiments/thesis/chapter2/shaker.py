"""The electrodynamic shaker on the beam of rig A in the frequency domain: Figs 2.15 to 2.20."""

import dataclasses

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.verdicts import Experiment, Outcome, finding
from jaxbeam.model.channels import shaker_chain
from jaxbeam.model.frequency_response import FrequencyResponse, extremes, frequency_response
from jaxbeam.plot.style import colour, name, styled

FREQUENCIES = np.geomspace(1.0, 1000.0, 4000)  # Hz
PARKED = ((0.3, 0.5),)  # m, kg: Fig. 2.16
ALUMINIUM = {"width": 0.06, "height": 3.3e-3, "youngs_modulus": 70e9, "density": 2700.0}
RIGID = {"flexural_rigidity": 1.022e5, "mass_per_length": 11.016}  # Fig. 2.20

HALF = "the mass in eq. (2.26), but not in (2.33)"


def data_physics_v4() -> jb.Electrodynamic:
    """The shaker of Table 2.3, at 0.5 m."""
    return jb.Electrodynamic(
        0.5, 0.82, 5e-5, 4.2, back_emf=4.2, mass=0.02, stiffness=9700.0, damping=0.55
    )


def run(load) -> Outcome:
    """Force drops and peaks of the force per voltage, the beam free or with 0.5 kg on it."""
    rig = dataclasses.replace(load("A").beam, modes=4)
    plain = jb.Beam(rig.length, damping_ratio=rig.damping_ratio, modes=4, **ALUMINIUM)
    undamped = dataclasses.replace(plain, damping_ratio=0.0)
    beams = {
        "as printed": rig,
        "aluminium of 70 GPa, 2700 kg/m^3, 3.3 mm high": plain,
        "the same without damping": undamped,
    }
    free = {word: _seen(_response(beam)) for word, beam in beams.items()}
    parked = {word: _seen(_response(beam, PARKED)) for word, beam in beams.items()}
    parked[HALF] = _seen(_in_impedance_alone(rig))
    parked[f"{HALF}, beam of aluminium"] = _seen(_in_impedance_alone(plain))
    transmitted = max(_peaks(_response(rig), 2), key=lambda pair: pair[1])

    def told(printed, found, what):
        values = {word: what(one) for word, one in found.items()}
        return finding(printed, values.pop("as printed"), values)

    findings = (
        told(published.DROPS, free, lambda one: one["drops"][:4]),
        told(published.SHAKER_GAIN, free, lambda one: [one["low"], one["peak"][1]]),
        told(published.SHAKER_PEAK, free, lambda one: one["peak"][0]),
        finding(published.TRANSMITTED_PEAK, transmitted[0]),
        told(published.PARKED_DROP, parked, lambda one: one["drops"][0]),
        told(published.PARKED_PLACE, parked, lambda one: one["peak"][0]),
        told(published.PARKED_PEAK, parked, lambda one: one["peak"][1]),
    )
    stiff = dataclasses.replace(rig, **{key: np.asarray(value) for key, value in RIGID.items()})
    return Outcome(findings, {"responses": _draw(rig, stiff)})


def _response(beam: jb.Beam, parked=()) -> FrequencyResponse:
    case = jb.Case(beam, actuators=[data_physics_v4()])
    return frequency_response(case, FREQUENCIES, shaker_chain(0), parked)


def _in_impedance_alone(beam: jb.Beam) -> FrequencyResponse:
    """With the parked mass in the coil's impedance, eq. (2.26), but not in eq. (2.33).

    Both have the accelerance of the beam in them, and (2.30) with the mass is written for one.
    """
    bare, laden = _response(beam).values, _response(beam, PARKED)
    force = laden.values[:, 3] / laden.values[:, 2] * bare[:, 2]
    return eqx.tree_at(lambda found: found.values, laden, laden.values.at[:, 3].set(force))


def _peaks(response: FrequencyResponse, pair: int) -> list[tuple[float, float]]:
    """Peaks of a response: frequency (Hz) and height."""
    return [(place, height) for word, place, height in extremes(response, pair) if word == "peak"]


def _seen(response: FrequencyResponse) -> dict:
    """Of the force per voltage: its start (N/V), drops (Hz) and largest peak (Hz, N/V)."""
    found = extremes(response, 3)
    drops = [place for word, place, height in found if word == "dip" and height < found[0][2]]
    return {
        "low": found[0][2],
        "drops": drops,
        "peak": max(_peaks(response, 3), key=lambda pair: pair[1]),
    }


@styled
def _draw(beam, stiff) -> Figure:
    """Magnitudes along the chain of the shaker, with the axes of Figs 2.15 to 2.18 and 2.20."""
    figure = Figure(figsize=(7.2, 5.6))
    panels = figure.subplots(2, 2, sharex=True)
    free, parked, rigid = _response(beam), _response(beam, PARKED), _response(stiff)
    lines = (
        ("force per voltage (N/V), Figs 2.15, 2.16", 3, np.abs, (free, parked)),
        (
            "impedance (\N{GREEK CAPITAL LETTER OMEGA}), Fig. 2.17",
            0,
            lambda h: 1 / np.abs(h),
            (free, parked),
        ),
        ("force on the beam per coil force, Fig. 2.18", 2, np.abs, (free, parked)),
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
    name(figure, "Electrodynamic shaker on the beam of rig A")
    return figure


EXPERIMENT = Experiment(
    "shaker",
    "Figs 2.15 to 2.20",
    "The force of the shaker drops at the resonances of the beam and peaks between; below 10 Hz it"
    " is proportional to the voltage.",
    run,
)
