"""Command `stability`: margins, poles and growth of the closed loop."""

import math
from pathlib import Path

from jaxbeam.cli.options import CaseOptions, PictureOptions, table


def stability(
    case: Path,
    /,
    *,
    limits: bool = False,
    headway: float | None = None,
    plot: bool = False,
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute stability margins, poles with loads frozen along the crossing, and growth over it.

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
    plot
        Draw the poles along the crossing to CASE_poles.png in this folder.
    """
    picture = pictures.path(plot, None, case.with_stem(f"{case.stem}_poles"))
    options.check_outputs(picture)
    parsed_case = options.read(case)

    from jaxbeam.analysis.linearised_loop import linearised_loop
    from jaxbeam.analysis.margins import margins
    from jaxbeam.analysis.stability import frozen_poles, growth, stream
    from jaxbeam.analysis.stability_limits import (
        largest_frozen_pole,
        load_stability_limits,
        stream_excess,
    )

    # Before the first load: loads off the beam leave the loop as it is.
    unloaded = linearised_loop(parsed_case, -1.0)
    stable = bool(unloaded.poles().real.max() < 0)
    loop_margins = (
        [margins(unloaded, i) for i in range(len(parsed_case.actuators))] if stable else []
    )
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
        from jaxbeam.plot import plot_poles

        title = parsed_case.title if pictures.title is None else pictures.title
        figure = plot_poles(poles, crossing_growth, title, ax=pictures.page())
        pictures.save(figure, picture)
    worst = int(poles.largest_real_part.argmax())
    content = {
        "stable_without_loads": stable,
        "margins": [
            {
                "gain": entry.gain,
                "gain_down": entry.lower_gain,
                "phase": entry.phase,
                "delay": entry.delay,
                "distance": entry.modulus_margin,
            }
            for entry in loop_margins
        ],
        "largest_real_part": poles.largest_real_part[worst],
        "at_time": poles.times[worst],
        "largest_growth": None if crossing_growth is None else crossing_growth.factor.max(),
        "largest_multiplier": None if load_stream is None else load_stream.largest_multiplier,
        "unstable_from": {
            name: {"mass": limit.mass, "speed": limit.speed} for name, limit in load_limits.items()
        },
    }
    lines = [f"without loads the loop is {'stable' if stable else 'unstable'}"]
    lines += table(
        ("actuator", "gain margin", "phase margin (deg)", "delay margin (s)", "modulus margin"),
        [
            (
                i,
                f"{entry.gain:.4g}",
                f"{math.degrees(entry.phase):.4g}",
                f"{entry.delay:.4g}",
                f"{entry.modulus_margin:.4g}",
            )
            for i, entry in enumerate(loop_margins)
        ],
    )
    if crossing_growth is not None:
        lines += [
            f"with the loads frozen where they are worst, at {poles.times[worst]:.4g} s, the"
            f" largest real part of a pole is {poles.largest_real_part[worst]:.4g} 1/s",
            "over the crossing a deviation grows at most by a factor of"
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
    options.report(content, lines, picture)


def _limit_text(quantity: str, value: float, unit: str) -> str:
    """Range of a mass or speed in which the loop is unstable, from its lower end."""
    if value == 0:
        return f"at every {quantity} that was tried"
    return (
        f"at no {quantity} that was tried" if math.isinf(value) else f"from {value:.4g} {unit} on"
    )
