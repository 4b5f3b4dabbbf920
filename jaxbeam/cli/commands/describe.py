"""Command about cases and vehicles: `describe`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.options import (
    DrawingOptions,
    OutputOptions,
    PrintOptions,
    table,
)
from jaxbeam.runtime.printer import counted

if TYPE_CHECKING:
    from jaxbeam.case.case import Case
    from jaxbeam.case.loads.base import AbstractLoad, VehicleModel

GRAVITY = 9.81  # m/s^2, of vehicles without a case
FAST = 5.0  # m/s, from where speeds are in km/h too
MAX_LOADS = 6  # of a case that are described
MAX_WHEELS = 12  # of a load of a case with a row each


def describe(
    source: str = "",
    /,
    *,
    plot: Path | None = None,
    pictures: DrawingOptions = DrawingOptions(),
    options: OutputOptions = OutputOptions(),
) -> None:
    """Describe vehicles, static wheel loads and frequencies, and cases in numbers.

    Parameters
    ----------
    source
        Vehicle file or case file, TOML, or a vehicle or train of the library by name; its names are
        listed if left out.
    plot
        Draw the vehicles to this file, OUT.png, OUT.svg or OUT.pdf.
    """
    pictures.check(plot)
    options.check_outputs(plot)
    if not source:
        _list_library(options)
        return
    is_file = source.endswith(".toml")
    content = read_toml(source, "file") if is_file else {}
    if not is_file:
        results = [_of_library(source)]
    elif "beam" in content or "loads" in content:
        results = _of_case(source)
    else:
        from jaxbeam.case.loads.vehicles import load_vehicle

        vehicle = load_vehicle(Path(source))
        title = vehicle.title or Path(source).stem
        results = [_result(title, vehicle.source, vehicle.model, GRAVITY)]
    is_case = is_file and ("beam" in content or "loads" in content)
    about, lines = _about_case(source) if is_case else ({}, [])
    for result in results:
        lines += [*([""] if lines else []), *_lines(result, is_case)]
    drawn = plot if results else None
    if drawn:
        from jaxbeam.plot import plot_vehicles

        titles = [result["title"] for result in results]
        title = pictures.title or ""
        figure = plot_vehicles(_loads(source, content), titles, ax=pictures.page(), title=title)
        pictures.save(figure, drawn)
    options.report({"vehicles": results} | about, lines, drawn)


def _about_case(path: str) -> tuple[dict[str, Any], list[str]]:
    """Description of a case: numbers by their names in JSON, and lines of text."""
    import jaxbeam as jb
    from jaxbeam.case.display import with_prefix

    case = jb.load_case(path)
    found, frequencies = jb.check(case), jb.modes(case).frequencies
    lines = [
        case.title or Path(path).stem,
        _beam_words(case),
        f"natural frequencies (Hz): {', '.join(f'{one:.5g}' for one in frequencies)}",
    ]
    if found.own_deflection is not None:
        own = with_prefix(found.own_deflection, "m")
        lines.append(f"static deflection under its own weight: {own}")
    if found.deflection and found.span_over_deflection:
        lines.append(
            f"largest static deflection under the loads: {with_prefix(found.deflection, 'm')},"
            f" 1/{found.span_over_deflection:.0f} of the span of {found.span:.4g} m"
        )
    lines += settlement_words(case)
    if found.critical_speed is not None:
        lines.append(f"critical speed: {_speed(found.critical_speed)}")
    lines += [*_load_times(case), *_sensor_words(case), f"plausibility: {found}"]
    numbers = jb.api.content(found) | {"frequencies_hz": frequencies}
    return {"case": numbers}, lines


def _beam_words(case: "Case") -> str:
    """Sentence on length, ends, supports, stiffness and mass of the beam of a case."""
    from jaxbeam.case.display import with_prefix

    beam, count = case.beam, len(case.supports)
    held = f", {counted(count, 'support')} between" if count else ""
    rigidity = with_prefix(float(beam.bending_stiffness), "N m^2", 6)
    return (
        f"beam of {float(beam.length):.6g} m, {beam.ends}{held}: E I = {rigidity},"
        f" {float(beam.linear_density):.6g} kg/m"
    )


def settlement_words(case: "Case") -> list[str]:
    """Line on settled supports, and the smallest and largest moment by them; none without."""
    import numpy as np

    from jaxbeam.case.display import with_prefix
    from jaxbeam.model.along_beam import positions_along, sections
    from jaxbeam.model.static_correction import bending_moment
    from jaxbeam.model.transfer_matrices import has_settlement, settled_beam

    if not has_settlement(case):
        return []
    settled = [
        f"supports.{i} by {with_prefix(float(support.settlement), 'm')}"
        for i, support in enumerate(case.supports)
        if support.settlement is not None
    ]
    x = positions_along(case)
    x = sections(case, x, "moment").points
    moments = np.array(bending_moment(case, x, settled_beam(case).field(x, 2)))
    moments[np.abs(moments) < 1e-9 * np.abs(moments).max()] = 0.0  # rounding errors
    low, high = (with_prefix(float(one), "N m") for one in (moments.min(), moments.max()))
    return [f"settled: {', '.join(settled)}; moments locked in from {low} to {high}"]


def _speed(value: float) -> str:
    """Text of a speed in m/s, from FAST on also in km/h."""
    text = f"{value:.4g} m/s"
    return f"{text} ({3.6 * value:.4g} km/h)" if abs(value) >= FAST else text


def _load_times(case: "Case") -> list[str]:
    """Lines on speed, entry and exit time of the first loads, and on the duration of the run."""
    from jaxbeam.case.case import crossing_times
    from jaxbeam.case.trajectory import NEVER

    if not case.loads:
        return ["the case has no loads"]
    lines, duration = [], float(case.run.duration)
    for i, (enter, leave) in enumerate(crossing_times(case)[:MAX_LOADS]):
        load = case.loads[i]
        name = getattr(load, "train", "") or getattr(load, "model", "") or load.kind
        speed = getattr(load, "speed", None)
        at = "" if speed is None else f" at {_speed(float(speed))}"
        end = f"to {leave:.4g} s" if leave < NEVER else "on, where it stays"
        lines.append(f"loads.{i}: {name}{at}, on the beam from {enter:.4g} s {end}")
    if len(case.loads) > MAX_LOADS:
        lines.append(f"and {len(case.loads) - MAX_LOADS} more loads")
    return [*lines, f"the run ends at {duration:.4g} s"]


def _sensor_words(case: "Case") -> list[str]:
    sensors = [
        f"{s.name or i} ({s.quantity} at {float(s.position):.4g} m)"
        for i, s in enumerate(case.sensors)
    ]
    return [f"sensors: {', '.join(sensors)}"] if sensors else ["the case has no sensors"]


def _loads(source: str, content: dict[str, Any]) -> "Sequence[AbstractLoad]":
    """Loads of a case, or one of a vehicle file, a vehicle or a train."""
    from jaxbeam.case.library.published import trains
    from jaxbeam.case.loads.axles import Axles
    from jaxbeam.case.loads.vehicles import VehicleLoad
    from jaxbeam.files.case_file import load_case

    if "beam" in content or "loads" in content:
        return load_case(source).loads
    if source in trains():
        return [Axles(train=source, speed=1.0)]
    return [VehicleLoad(model=source, speed=1.0)]


def _of_library(name: str) -> dict[str, Any]:
    from jaxbeam.case.fields import suggestion
    from jaxbeam.case.library.published import trains
    from jaxbeam.case.loads.axles import Axles
    from jaxbeam.case.loads.vehicles import load_vehicle, vehicle_names

    if name in trains():
        return _result(name, trains()[name].source, Axles(train=name, speed=1.0).vehicle, GRAVITY)
    if name in vehicle_names():
        vehicle = load_vehicle(name)
        return _result(vehicle.title, vehicle.source, vehicle.model, GRAVITY)
    raise ValueError(
        f"there is no vehicle or train {name!r} in the library (the name of a file ends in .toml);"
        f" {suggestion(name, [*vehicle_names(), *trains()])}"
    )


def _of_case(path: str) -> list[dict[str, Any]]:
    from jaxbeam.files.case_file import load_case

    case = load_case(path)
    results = []
    for i, load in enumerate(case.loads):
        count = len(load.spacings())
        title = f"loads.{i}: {load.kind}" + (f", {count} in a row, each:" if count > 1 else "")
        results.append(_result(title, "", load.vehicle, float(case.run.gravity)))
    return results


def _result(
    title: str, source: str, model: Callable[[Any], "VehicleModel"], gravity: float
) -> dict[str, Any]:
    """Numbers of a vehicle whose model is a function of gravity."""
    import numpy as np

    vehicle = model(np.float64(gravity))
    total = float(np.sum(vehicle.static_loads))
    return {
        "title": title,
        "source": source,
        "wheelbase": float(vehicle.offsets[-1] - vehicle.offsets[0]),
        "weight": total,
        "mass": total / gravity if gravity else None,
        "offsets": vehicle.offsets,
        "static_loads": vehicle.static_loads,
        "unsprung_masses": vehicle.wheel_masses,
        "degrees_of_freedom": list(vehicle.names),
        "frequencies_hz": vehicle.natural_frequencies(),
    }


def _lines(result: dict[str, Any], is_part: bool) -> list[str]:
    """Lines on a vehicle; of a part of a case the first and the last of many wheels."""
    lines = [result["title"]]
    if result["source"]:
        lines.append(f"source: {result['source']}")
    mass = "" if result["mass"] is None else f", mass {result['mass']:.6g} kg"
    base = f", wheelbase {result['wheelbase']:.6g} m" if len(result["offsets"]) > 1 else ""
    weight = result["weight"]
    words = f"{weight:.6g} N" if abs(weight) < 1e3 else f"{weight / 1e3:.6g} kN"
    lines.append(f"weight {words}{mass}{base}")
    columns = zip(result["offsets"], result["static_loads"], result["unsprung_masses"], strict=True)
    rows = [
        (str(i), f"{offset:.6g}", f"{load / 1e3:.6g}", f"{mass:.6g}")
        for i, (offset, load, mass) in enumerate(columns, 1)
    ]
    if is_part and len(rows) > MAX_WHEELS:
        lines.append(f"{len(rows)} wheels, of which")
        rows = [*rows[: MAX_WHEELS - 1], rows[-1]]
    if len(rows) > 1:
        lines += table(
            ("wheel", "behind the first (m)", "static load (kN)", "unsprung mass (kg)"), rows
        )
    if result["degrees_of_freedom"]:
        lines.append(f"degrees of freedom: {', '.join(result['degrees_of_freedom'])}")
        frequencies = ", ".join(f"{frequency:.5g}" for frequency in result["frequencies_hz"])
        lines.append(f"natural frequencies on a rigid road (Hz): {frequencies}")
    else:
        lines.append("no suspension: its wheels follow the surface")
    return lines


def _list_library(options: PrintOptions) -> None:
    from jaxbeam.case.library.published import line_loads, trains
    from jaxbeam.case.loads.vehicles import load_vehicle, vehicle_names

    vehicles = {name: load_vehicle(name).title for name in vehicle_names()}
    rows = [(name, title) for name, title in vehicles.items()]
    rows += [(name, counted(len(train.offsets), "axle")) for name, train in trains().items()]
    rows += [(name, "line load") for name in line_loads()]
    width = max(len(name) for name, _ in rows)
    options.report(
        {"vehicles": list(vehicles), "trains": list(trains()), "line_loads": list(line_loads())},
        [f"{name:{width}}  {what}" for name, what in rows],
    )
