"""Command `influence`: influence lines of a beam."""

from pathlib import Path

from jaxbeam.cli.arguments import check_suffix
from jaxbeam.cli.options import CaseOptions, Output, PictureOptions, table
from jaxbeam.files.endings import TABLES


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

    from jaxbeam.analysis.sections.influence_table import influence_table
    from jaxbeam.case.reading.units import number_in_si

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
    return f"{values[index]:.6g}", f"{found.positions[index]:.6g}"
