"""Command `stability`: margins, poles and growth of the closed loop."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from jaxbeam.cli.arguments import stationary_mass
from jaxbeam.cli.options import CaseOptions, PictureOptions, table

if TYPE_CHECKING:
    from jaxbeam.analysis.linearised_loop import LinearisedLoop
    from jaxbeam.analysis.stability import Margins


def stability(
    case: Path,
    /,
    *,
    limits: bool = False,
    headway: float | None = None,
    mass_at: tuple[str, ...] = (),
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Tell whether the loop is stable along the crossing; compute margins, poles and growth.

    `--plot` draws the poles along the crossing to CASE_poles.png in this folder, and Bode and
    Nyquist plots of the loop, broken at the first command, to CASE_loop.png.

    Parameters
    ----------
    case
        Case file with a controller, TOML.
    limits
        Search the critical mass and speed of the first load, the least at which the loop is
        unstable: up to ten times those of the case, or down to a tenth if that is unstable.
    headway
        Time (s) between the loads of an endless stream: compute the largest Floquet multiplier;
        with --limits, also the critical mass and speed in the stream.
    mass_at
        POSITION=MASS in m and kg: margins with this stationary mass in place of the loads; repeat
        it for more.
    """
    places = [stationary_mass(text) for text in mass_at]
    picture = pictures.path(None, case.with_stem(f"{case.stem}_poles"))
    loop_picture = picture and picture.with_stem(picture.stem.removesuffix("_poles") + "_loop")
    options.check_outputs(picture, loop_picture)
    parsed_case = options.read(case)

    from jaxbeam.analysis.linearised_loop import linearised_loop, loop_with_mass_at
    from jaxbeam.analysis.stability import (
        frozen_poles,
        growth,
        largest_frozen_pole,
        load_stability_limits,
        stability_margin,
        stream,
        stream_excess,
    )

    along_crossing = stability_margin(parsed_case)
    # Before the first load: loads off the beam leave the loop as it is.
    unloaded = linearised_loop(parsed_case, -1.0)
    loops = {"no load": unloaded}
    for position, mass in places:
        loops[f"{mass:g} kg at {position:g} m"] = loop_with_mass_at(parsed_case, position, mass)
    loop_margins = {name: _margins_of(loop) for name, loop in loops.items()}
    stable = bool(loop_margins["no load"])
    poles = frozen_poles(parsed_case)
    crossing_growth = growth(parsed_case) if parsed_case.loads else None
    load_stream = None if headway is None else stream(parsed_case, headway)
    measures = {"loads frozen": largest_frozen_pole} if limits else {}
    if limits and headway is not None:
        measures["a stream"] = stream_excess(headway)
    load_limits = {
        name: load_stability_limits(parsed_case, measure) for name, measure in measures.items()
    }
    if picture:
        from jaxbeam.plot import plot_loop_gain, plot_poles

        title = parsed_case.title if pictures.title is None else pictures.title
        figure = plot_poles(poles, crossing_growth, title, ax=pictures.page())
        pictures.save(figure, picture)
        figure = plot_loop_gain(loops, title=title, ax=pictures.page())
        pictures.save(figure, loop_picture)
    worst = int(poles.largest_real_part.argmax())
    content = {
        "verdict": along_crossing.verdict,
        "along_crossing": {
            "gain": along_crossing.gain,
            "delay": along_crossing.delay,
            "obstacle": along_crossing.obstacle,
        },
        "stable_without_loads": stable,
        "margins": [_margins_to_dict(entry) for entry in loop_margins["no load"]],
        "mass_at": [
            {
                "position": position,
                "mass": mass,
                "verdict": "stable" if found else "unstable",
                "margins": [_margins_to_dict(entry) for entry in found],
            }
            for (position, mass), found in zip(places, list(loop_margins.values())[1:], strict=True)
        ],
        "largest_real_part": poles.largest_real_part[worst],
        "at_time": poles.times[worst],
        "largest_growth": None if crossing_growth is None else crossing_growth.factor.max(),
        "largest_multiplier": None if load_stream is None else load_stream.largest_multiplier,
        "unstable_from": {
            name: {"mass": limit.mass, "speed": limit.speed} for name, limit in load_limits.items()
        },
    }
    lines = [f"the loop is {along_crossing}"]
    if along_crossing.verdict == "stable":
        lines.append(
            f"along the crossing the gain margin is at least {along_crossing.gain:.4g}, the delay"
            f" margin {along_crossing.delay:.4g} s"
        )
    lines += [f"unstable with {name}" for name, found in loop_margins.items() if not found]
    lines += table(
        (
            "load", "actuator", "gain margin", "phase margin (deg)", "delay margin (s)",
            "modulus margin",
        ),
        [
            (
                name,
                i,
                f"{entry.gain:.4g}",
                f"{math.degrees(entry.phase):.4g}",
                f"{entry.delay:.4g}",
                f"{entry.modulus_margin:.4g}",
            )
            for name, found in loop_margins.items()
            for i, entry in enumerate(found)
        ],
    )  # fmt: skip
    if crossing_growth is not None:
        lines += [
            f"with the loads frozen where they are worst, at {poles.times[worst]:.4g} s, but with"
            " their speed, the largest real part of a pole is"
            f" {poles.largest_real_part[worst]:.4g} 1/s",
            "over the crossing a small deviation from rest grows at most by a factor of"
            f" {crossing_growth.factor.max():.4g}, to {crossing_growth.factor[-1]:.3g} at its end",
        ]
    if load_stream is not None:
        lines.append(
            f"in an endless stream, a load every {load_stream.period:g} s, a deviation is"
            f" multiplied by at most {load_stream.largest_multiplier:.4g} each time:"
            f" {'' if load_stream.stable else 'un'}stable"
        )
    for name, limit in load_limits.items():
        for quantity, value, unit in (("mass", limit.mass, "kg"), ("speed", limit.speed, "m/s")):
            if value is not None:
                found = _limit_text(quantity, value, unit)
                lines.append(f"with {name} the loop is unstable {found}")
    options.report(content, lines, picture, loop_picture)


def _margins_of(loop: "LinearisedLoop") -> list["Margins"]:
    """Margins at each command; none of an unstable loop."""
    import numpy as np

    from jaxbeam.analysis.stability import margins

    if loop.poles().real.max() >= 0:
        return []
    with np.errstate(divide="ignore"):  # infinite margin of a loop without gain
        return [margins(loop, i) for i in range(loop.B.shape[1])]


def _margins_to_dict(entry: "Margins") -> dict[str, float]:
    return {
        "gain": entry.gain,
        "gain_down": entry.lower_gain,
        "phase": entry.phase,
        "delay": entry.delay,
        "distance": entry.modulus_margin,
    }


def _limit_text(quantity: str, value: float, unit: str) -> str:
    """Range of a mass or speed in which the loop is unstable, from its lower end."""
    if value == 0:
        return f"at every {quantity} that was tried"
    return (
        f"at no {quantity} that was tried" if math.isinf(value) else f"from {value:.4g} {unit} on"
    )
