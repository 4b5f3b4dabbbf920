"""Commands about results that an engineer signs: checks by codes, influence lines."""

import math
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import check_suffix, refuse_option
from jaxbeam.cli.options import (
    CaseOptions,
    Output,
    PictureOptions,
    ReadingOptions,
    print_warnings,
    table,
)
from jaxbeam.runtime.output_file import TABLES
from jaxbeam.runtime.printer import counted

ZERO = 1e-5  # fraction of the largest value of a quantity that is printed as 0


def assess(
    case: Path,
    /,
    *,
    line_speed: Annotated[str, Parameter(required=True)],
    code: str = "en1991-2",
    deck: str = "ballasted",
    track: str = "standard",
    spread: str | None = None,
    classification: float = 1.0,
    determinant_length: str | None = None,
    added_damping: float = 0.0,
    lowest_speed: str | None = None,
    train: tuple[str, ...] = (),
    dynamic: bool = False,
    output: Output = None,
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Check a railway bridge by a code: dynamic factors, deck acceleration, trains against LM71.

    Each check cites its clause; what the model cannot show is listed and not certified. `--plot`
    draws the effects of the trains over speed to CASE_assessment.png in this folder, or beside the
    report.

    Parameters
    ----------
    case
        Case file, TOML, of which beam and supports count.
    line_speed
        Maximum line speed at the site, as "250 km/h", or a number in m/s.
    code
        en1991-2: section 6.4 of EN 1991-2, with EN 1990, annex A2.
    deck
        ballasted or slab.
    track
        State of the track: standard, or maintained with care. Calculated effects of trains are
        multiplied by 1 + phi'' or 1 + phi''/2.
    spread
        How the track spreads the axles of trains, in place of the case's: "3 sleepers", or a length
        as "2.4 m".
    classification
        Factor alpha of LM71.
    determinant_length
        L_phi by table 6.2 of EN 1991-2, as "30 m"; needed for more than one span.
    added_damping
        Ratio to add to the damping, by 6.4.6.4.
    lowest_speed
        Start of the speeds of the dynamic analysis, as "150 km/h"; 40 m/s if left out.
    train
        Train of the library, as HSLM-A1; repeat it for more. All of HSLM-A if left out.
    dynamic
        Make the dynamic analysis also where it is not required.
    output
        Write the report to this file, OUT.md.
    """
    check_suffix(output, ".md", "a report")
    picture = pictures.path(output, case.with_stem(f"{case.stem}_assessment"))
    options.check_outputs(output, picture)
    found = jb.assess(
        options.read(case, judged="structure"),
        _number_or_quantity(line_speed),
        code=code,
        deck=deck,
        track=track,
        spread=spread,
        classification=classification,
        determinant_length=_number_or_quantity(determinant_length),
        added_damping=added_damping,
        lowest_speed=_number_or_quantity(lowest_speed),
        dynamic=True if dynamic else None,
        progress=not options.json_,
        **({"trains": train} if train else {}),
    )
    if output:
        found.save(output, options.overwrite)
    if picture:
        pictures.save(found.plot(ax=pictures.page(), title=pictures.title), picture)
    options.report(found.to_dict(), found.lines, output, picture)


def _number_or_quantity(text: str | None) -> float | str | None:
    """A number of a text, or the text itself, as "25 m"."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


def envelope(
    case: Path,
    /,
    vehicle: str,
    *,
    quantity: tuple[str, ...] = ("moment", "shear"),
    at: tuple[str, ...] = (),
    lane: str | None = None,
    impact: float | None = None,
    speed: str | None = None,
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute extremes under a load model of a code: a vehicle at its worst place and a lane load.

    Parameters
    ----------
    case
        Case file, TOML, of which beam, supports and actuators at rest count, not its loads.
    vehicle
        HL-93, HL-93-pair, LM1, M1600, S1600, CL-625, HB45, or a train of the library, as HSLM-A1.
    quantity
        moment, shear, reaction, deflection, rotation, ...; repeat it for more.
    at
        Position of a section, as 12.5 (m) or "12.5 m"; repeat it for more. By default supports,
        midspans and quarter points; reactions at supports.
    lane
        Lane load where it is unfavourable, as 9300 (N/m) or "9.3 kN/m"; by default that of the
        load model.
    impact
        Allowance for dynamics, added to effects of axles, 0.33 for a third; by default that of the
        load model.
    speed
        Speed, as 20 (m/s) or "80 km/h": print the dynamic extremes of its axles too.
    output
        Write the extremes to a table: OUT.csv, .xlsx, .mat or .parquet.
    """
    check_suffix(output, TABLES[0], "a table of extremes", TABLES[1:])
    options.check_outputs(output)
    parsed_case = options.read(case, judged="structure")

    from jaxbeam.analysis.load_models import crossing_envelope, load_model_envelope
    from jaxbeam.case.display import text_scale
    from jaxbeam.case.toml_file import number_in_si
    from jaxbeam.model.statics import REACTION, unit_of_effect

    lane_load = None if lane is None else number_in_si(lane, "N/m", "--lane")
    velocity = None if speed is None else number_in_si(speed, "m/s", "--speed")
    columns = {name: [] for name in ("quantity", "place", "x (m)", "lowest", "highest")}
    dynamic = {"dynamic lowest": [], "dynamic highest": []}
    rows = []
    for name in quantity:
        places, x = _sections(parsed_case, name, at)
        found = load_model_envelope(
            parsed_case, vehicle, x, quantity=name, lane=lane_load, allowance=impact
        )
        of_crossing = [()] * len(x)
        if velocity is not None and name != REACTION:
            moving = crossing_envelope(parsed_case, vehicle, velocity, x, quantity=name)
            of_crossing = list(zip(*moving, strict=True))
        scale = text_scale([found.lowest, found.highest], unit_of_effect(name))
        for i, place in enumerate(found.positions):
            low, high = found.lowest[i], found.highest[i]
            label = places.get(float(place), "")
            entries = name, label, float(place), float(low), float(high)
            for head, entry in zip(columns, entries, strict=True):
                columns[head].append(entry)
            for head, entry in zip(dynamic, of_crossing[i] or (math.nan, math.nan), strict=True):
                dynamic[head].append(float(entry))
            largest = max(-found.lowest.min(), found.highest.max())
            low, high, *moving = (
                _text(one, largest, scale.factor) for one in (low, high, *of_crossing[i])
            )
            extremes = [scale.unit, low, str(found.at_lowest[i]) if low != "0" else ""]
            extremes += [high, str(found.at_highest[i]) if high != "0" else ""]
            if velocity is not None:
                extremes += moving or ["", ""]
            rows.append((f"{name} at {label or f'{place:g} m'}", *extremes))
    if velocity is not None:
        columns |= dynamic
    if output:
        import numpy as np

        from jaxbeam.files.tables import write_table

        write_table(output, {k: np.array(v) for k, v in columns.items()}, options.overwrite)
    heads = "section", "unit", "lowest", "under", "highest", "under"
    heads += ("dynamic lowest", "highest") if velocity is not None else ()
    lines = ["extremes, and the place of the vehicle:", *table(heads, rows)]
    options.report(columns, lines, output)


def combine(
    case: Path,
    actions: Path,
    /,
    *,
    quantity: tuple[str, ...] = ("moment", "shear"),
    at: tuple[str, ...] = (),
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Combine actions with factors: design values along a beam, and the combinations that govern.

    Parameters
    ----------
    case
        Case file, TOML.
    actions
        TOML file: tables [actions.NAME], each with uniform = "12 kN/m" or "self-weight",
        model = "LM1" (with speed, lane or impact), or loads = "case"; and tables
        [combinations.NAME] of factors, ACTION = 1.35, or [1.35, 1.0] if it may be favourable.
    quantity
        moment, shear, reaction, deflection, rotation, ...; repeat it for more.
    at
        Position of a section, as 12.5 (m) or "12.5 m"; repeat it for more. By default supports,
        midspans and quarter points; reactions at supports.
    output
        Write the design values to a table: OUT.csv, .xlsx, .mat or .parquet.
    """
    check_suffix(output, TABLES[0], "a table of design values", TABLES[1:])
    options.check_outputs(output)
    parsed_case = options.read(case, judged="structure")
    tables = read_toml(actions, "table of actions")
    refuse_option(
        set(tables) != {"actions", "combinations"}
        or not all(isinstance(one, dict) for part in tables.values() for one in part.values()),
        f"{actions}: tables of actions are [actions.NAME] and [combinations.NAME], nothing else",
    )

    from jaxbeam.analysis.combinations import combine as combine_actions
    from jaxbeam.case.display import text_scale
    from jaxbeam.model.statics import unit_of_effect

    columns: dict[str, list] = {}
    rows = []
    for name in quantity:
        places, x = _sections(parsed_case, name, at)
        found = combine_actions(parsed_case, **tables, x=x, quantity=name)
        low, high = found.lowest, found.highest
        scale = text_scale([low, high], unit_of_effect(name))
        for i, place in enumerate(found.positions):
            label = places.get(float(place), "")
            worst = int(low[:, i].argmin()), int(high[:, i].argmax())
            entry = {"quantity": name, "place": label, "x (m)": float(place)}
            for k, combination in enumerate(found.names):
                entry[f"lowest {combination}"] = float(low[k, i])
                entry[f"highest {combination}"] = float(high[k, i])
            for head, value in entry.items():
                columns.setdefault(head, []).append(value)
            largest = max(-low.min(), high.max())
            extremes = (
                _text(one, largest, scale.factor) for one in (low[worst[0], i], high[worst[1], i])
            )
            by = (found.names[k] for k in worst)
            pairs = (text for pair in zip(extremes, by, strict=True) for text in pair)
            rows.append((f"{name} at {label or f'{place:g} m'}", scale.unit, *pairs))
    if output:
        import numpy as np

        from jaxbeam.files.tables import write_table

        write_table(output, {k: np.array(v) for k, v in columns.items()}, options.overwrite)
    heads = "section", "unit", "lowest", "combination", "highest", "combination"
    lines = ["design values, and the combination of each:", *table(heads, rows)]
    options.report(columns, lines, output)


def _sections(case: "jb.Case", quantity: str, at: tuple[str, ...]) -> tuple[dict, list[float]]:
    """Names of characteristic points by position (m), and positions of sections of a quantity."""
    from jaxbeam.analysis.sections import characteristic_points
    from jaxbeam.case.toml_file import number_in_si
    from jaxbeam.model.elements import held_positions
    from jaxbeam.model.statics import REACTION

    places = {point.x: point.name for point in characteristic_points(case)}
    given = [number_in_si(text, "m", "--at") for text in at]
    return places, given or list(held_positions(case) if quantity == REACTION else places)


def influence(
    case: Path,
    /,
    *,
    quantity: tuple[str, ...] = (),
    at: tuple[str, ...] = (),
    fibre_distance: float | None = None,
    section_modulus: float | None = None,
    output: Output = None,
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute influence lines: values at a section over the position of a load of 1 N.

    `--plot` draws them to CASE_influence.png in this folder, or beside the output.

    Parameters
    ----------
    case
        Case file, TOML, of which beam, supports and actuators at rest count.
    quantity
        deflection, rotation, moment, shear, reaction, ...; repeat it for more. By default moments
        and deflections at midspans, support moments and reactions.
    at
        Position of a section, as 12.5 (m) or "12.5 m"; repeat it for more. By default supports,
        midspans and quarter points.
    fibre_distance
        Height of a fibre above the neutral axis in m, for strain.
    section_modulus
        Bending moment over stress in m^3, for stress.
    output
        Write the lines to a table: OUT.csv, .xlsx, .mat or .parquet.
    """
    check_suffix(output, TABLES[0], "a table of influence lines", TABLES[1:])
    picture = pictures.path(output, case.with_stem(f"{case.stem}_influence"))
    options.check_outputs(output, picture)
    parsed_case = options.read(case, judged="structure")

    from jaxbeam.analysis.sections import influence_table
    from jaxbeam.case.toml_file import number_in_si

    sections = tuple(number_in_si(text, "m", "--at") for text in at)
    found = influence_table(
        parsed_case,
        quantity,
        sections,
        fibre_distance=fibre_distance,
        section_modulus=section_modulus,
    )
    if output:
        from jaxbeam.files.tables import write_table

        write_table(output, found.columns, options.overwrite)
    if picture:
        from jaxbeam.plot import plot_influence

        figure = plot_influence(parsed_case, found, ax=pictures.page(), title=pictures.title)
        pictures.save(figure, picture)
    rows = []
    for i, (head, values) in enumerate(list(found.columns.items())[1:]):
        low, high = values.argmin(), values.argmax()
        rows.append(
            (
                head.removesuffix(f" ({found.units[i]})"),
                "" if found.units[i] == "1" else found.units[i],
                *(text for j in (low, high) for text in _value_and_place(found, values, j)),
            )
        )
    header = ("line", "unit", "smallest", "load at (m)", "largest", "load at (m)")
    options.report(dict(found.columns), table(header, rows), output, picture)


def _value_and_place(found, values, index) -> tuple[str, str]:
    return _text(values[index], abs(values).max(), digits=6), f"{found.positions[index]:.6g}"


def _text(value, largest, factor: float = 1.0, digits: int = 5) -> str:
    """A value over a factor with so many digits, or 0 if it is round-off of the largest."""
    return "0" if abs(value) < ZERO * largest else f"{value / factor:.{digits}g}"


def check(case: Path, /, *, options: ReadingOptions = ReadingOptions()) -> None:
    """Check a case without running it: errors, and warnings of what looks wrong, as units.

    Parameters
    ----------
    case
        Case file, TOML.
    """
    found = jb.check(options.read(case, judged=""))
    print_warnings(found)
    number = len(found.warnings)
    words = "nothing looks wrong" if not number else counted(number, "warning")
    options.report(jb.api.content(found), [f"plausibility: {found}", words])
