"""The command that tells whether a closed loop is stable."""

from pathlib import Path

import numpy as np

from jaxbeam.cli.app import Json, Overwrite, Settings, app
from jaxbeam.cli.arguments import check_outputs, picture_path, read_case
from jaxbeam.cli.printing import print_json, print_table, print_written


@app.command
def stability(
    case: Path,
    /,
    *,
    set_: Settings = (),
    limits: bool = False,
    spacing: float | None = None,
    plot: bool = False,
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Tell whether the closed loop is stable: margins, frozen poles, growth over the crossing.

    Parameters
    ----------
    case
        Case file with a controller, TOML.
    limits
        Search the mass and the speed of the first load from which the loop is unstable, from those
        of the case up to ten times as much, or down to a tenth where it is unstable as it is.
    spacing
        Also of an endless stream of the load, one every so many seconds: what a period multiplies
        deviations by (Floquet); with --limits, where that exceeds one.
    plot
        Draw the poles along the crossing to CASE_poles.png in this folder.
    """
    from jaxbeam.analysis.linearised_loop import linearised_loop
    from jaxbeam.analysis.margins import margins
    from jaxbeam.analysis.stability import frozen_poles, growth, stream
    from jaxbeam.analysis.stability_limits import (
        largest_frozen_pole,
        load_stability_limits,
        stream_excess,
    )

    picture = picture_path(None, case.with_stem(f"{case.stem}_poles")) if plot else None
    check_outputs(overwrite, picture)
    parsed_case = read_case(case, set_)
    # Before the first load: loads off the beam leave the loop as it is.
    unloaded_loop = linearised_loop(parsed_case, -1.0)
    stable = bool(unloaded_loop.poles().real.max() < 0)
    loop_margins = (
        [margins(unloaded_loop, i) for i in range(len(parsed_case.actuators))] if stable else []
    )
    poles = frozen_poles(parsed_case)
    deviation_growth = growth(parsed_case) if parsed_case.loads else None
    floquet = None if spacing is None else stream(parsed_case, spacing)
    by = {"loads frozen": largest_frozen_pole} if limits else {}
    by |= {"a stream": stream_excess(spacing)} if limits and spacing is not None else {}
    stability_limits = {
        word: load_stability_limits(parsed_case, measure) for word, measure in by.items()
    }
    if picture:
        from jaxbeam.plot import plot_poles

        plot_poles(poles, deviation_growth, parsed_case.title).savefig(picture)
    worst = int(np.argmax(poles.largest_real_part))
    if json_:
        print_json(
            {
                "stable_without_loads": stable,
                "margins": [entry._asdict() for entry in loop_margins],
                "largest_real_part": poles.largest_real_part[worst],
                "at_time": poles.times[worst],
                "largest_growth": None
                if deviation_growth is None
                else deviation_growth.factor.max(),
                "largest_multiplier": None if floquet is None else floquet.largest_multiplier,
                "unstable_from": {word: each._asdict() for word, each in stability_limits.items()},
            }
        )
        return
    print("without loads the loop is", "stable" if stable else "unstable")
    print_table(
        ("actuator", "gain margin", "phase margin (deg)", "delay margin (s)", "distance"),
        [
            (
                i,
                f"{entry.gain:.4g}",
                f"{np.degrees(entry.phase):.4g}",
                f"{entry.delay:.4g}",
                f"{entry.modulus_margin:.4g}",
            )
            for i, entry in enumerate(loop_margins)
        ],
    )
    if deviation_growth is not None:
        print(
            f"with the loads frozen where they are worst, at {poles.times[worst]:.4g} s, the"
            f" largest real part of a pole is {poles.largest_real_part[worst]:.4g} 1/s"
        )
        print(
            "over the crossing a deviation grows at most by a factor of"
            f" {deviation_growth.factor.max():.4g}, to {deviation_growth.factor[-1]:.3g} at its end"
        )
    if floquet is not None:
        print(
            f"in an endless stream, a load every {floquet.period:g} s, a deviation is multiplied by"
            f" at most {floquet.largest_multiplier:.4g} each time: {'' if floquet.stable else 'un'}stable"
        )
    for word, loop_margins in stability_limits.items():
        pairs = (("mass", loop_margins.mass, "kg"), ("speed", loop_margins.speed, "m/s"))
        for name, value, unit in pairs:
            if value is not None:
                print(f"with {word} the loop is unstable {_limit_text(name, value, unit)}")
    print_written(picture)


def _limit_text(name: str, value: float, unit: str) -> str:
    """From where on a loop is unstable, in words."""
    if value == 0:
        return f"at every {name} that was tried"
    return f"at no {name} that was tried" if value == np.inf else f"from {value:.4g} {unit} on"
