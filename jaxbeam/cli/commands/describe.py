"""Command about cases and vehicles: `describe`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxbeam.case.reading.toml_file import read_toml
from jaxbeam.cli.options import (
    DrawingOptions,
    OutputOptions,
    PrintOptions,
    numbers_of,
    print_message,
    table,
)

if TYPE_CHECKING:
    from jaxbeam.case.loads.base import AbstractLoad
    from jaxbeam.case.loads.vehicle_model import VehicleModel

GRAVITY = 9.81  # m/s^2, of vehicles without a case


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
        from jaxbeam.case.loads.planar.files import load_vehicle

        vehicle = load_vehicle(Path(source))
        title = vehicle.title or Path(source).stem
        results = [_result(title, vehicle.source, vehicle.model, GRAVITY)]
    is_case = is_file and ("beam" in content or "loads" in content)
    about, lines = _about_case(source) if is_case else ({}, [])
    for result in results:
        lines += [*([""] if lines else []), *_lines(result)]
    drawn = plot if results else None
    if drawn:
        from jaxbeam.plot import plot_vehicles

        titles = [result["title"] for result in results]
        title = pictures.title or ""
        figure = plot_vehicles(_loads(source, content), titles, ax=pictures.page(), title=title)
        pictures.save(figure, drawn)
    options.report({"vehicles": results} | about, lines, drawn)


def _about_case(path: str) -> tuple[dict[str, Any], list[str]]:
    """What a case is, in numbers by their names in JSON and in words."""
    import jaxbeam as jb

    case = jb.load_case(path)
    found, frequencies = jb.check(case), jb.modes(case).frequencies
    for warning in found.warnings:
        print_message(f"warning: {warning}")
    beam = case.beam
    held = f"{beam.ends}, {len(case.supports)} supports between" if case.supports else beam.ends
    lines = [
        case.title or Path(path).stem,
        f"beam of {float(beam.length):.6g} m, {held}: E I = {float(beam.bending_stiffness):.6g}"
        f" N m^2, {float(beam.linear_density):.6g} kg/m",
        f"natural frequencies (Hz): {', '.join(f'{one:.5g}' for one in frequencies)}",
    ]
    if found.own_deflection is not None:
        lines.append(f"static deflection under its own weight: {found.own_deflection:.4g} m")
    if found.deflection:
        lines.append(
            f"largest static deflection under the loads: {found.deflection:.4g} m, 1/"
            f"{found.span_over_deflection:.4g} of the span of {found.span:.4g} m"
        )
    if found.critical_speed is not None:
        lines.append(f"critical speed: {found.critical_speed:.4g} m/s")
    lines.append(f"plausibility: {found}")
    if not case.loads:
        lines.append("the case has no loads")
    numbers = numbers_of(found) | {"frequencies_hz": frequencies}
    return {"case": numbers}, lines


def _loads(source: str, content: dict[str, Any]) -> "Sequence[AbstractLoad]":
    """Loads of a case, or one of a vehicle file, a vehicle or a train."""
    from jaxbeam.case.loads.axles import Axles
    from jaxbeam.case.loads.vehicle import VehicleLoad
    from jaxbeam.files.case_file import load_case
    from jaxbeam.vehicles.trains import trains

    if "beam" in content or "loads" in content:
        return load_case(source).loads
    if source in trains():
        return [Axles(train=source, speed=1.0)]
    return [VehicleLoad(model=source, speed=1.0)]


def _of_library(name: str) -> dict[str, Any]:
    from jaxbeam.case.declared_checks import suggestion
    from jaxbeam.case.loads.axles import Axles
    from jaxbeam.case.loads.planar.files import load_vehicle, vehicle_names
    from jaxbeam.vehicles.trains import trains

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


def _lines(result: dict[str, Any]) -> list[str]:
    lines = [result["title"]]
    if result["source"]:
        lines.append(f"source: {result['source']}")
    mass = "" if result["mass"] is None else f", mass {result['mass']:.6g} kg"
    lines.append(
        f"weight {result['weight'] / 1e3:.6g} kN{mass}, wheelbase {result['wheelbase']:.6g} m"
    )
    columns = zip(result["offsets"], result["static_loads"], result["unsprung_masses"], strict=True)
    lines += table(
        ("wheel", "behind the first (m)", "static load (kN)", "unsprung mass (kg)"),
        [
            (i, f"{offset:.6g}", f"{load / 1e3:.6g}", f"{mass:.6g}")
            for i, (offset, load, mass) in enumerate(columns, 1)
        ],
    )
    if result["degrees_of_freedom"]:
        lines.append(f"degrees of freedom: {', '.join(result['degrees_of_freedom'])}")
        frequencies = ", ".join(f"{frequency:.5g}" for frequency in result["frequencies_hz"])
        lines.append(f"natural frequencies on a rigid road (Hz): {frequencies}")
    else:
        lines.append("no suspension: its wheels follow the surface")
    return lines


def _list_library(options: PrintOptions) -> None:
    from jaxbeam.case.loads.planar.files import load_vehicle, vehicle_names
    from jaxbeam.vehicles.line_loads import line_loads
    from jaxbeam.vehicles.trains import trains

    vehicles = {name: load_vehicle(name).title for name in vehicle_names()}
    rows = [(name, title) for name, title in vehicles.items()]
    rows += [(name, f"{len(train.offsets)} axles") for name, train in trains().items()]
    rows += [(name, "line load") for name in line_loads()]
    width = max(len(name) for name, _ in rows)
    options.report(
        {"vehicles": list(vehicles), "trains": list(trains()), "line_loads": list(line_loads())},
        [f"{name:{width}}  {what}" for name, what in rows],
    )
