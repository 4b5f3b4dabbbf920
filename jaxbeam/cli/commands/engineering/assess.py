"""Command `assess`: checks of a bridge by a code."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.cli.arguments import check_suffix
from jaxbeam.cli.options import CaseOptions, Output, PictureOptions


def assess(
    case: Path,
    /,
    *,
    line_speed: Annotated[str, Parameter(required=True)],
    code: str = "en1991-2",
    deck: str = "ballasted",
    track: str = "standard",
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
        classification=classification,
        determinant_length=_number_or_quantity(determinant_length),
        added_damping=added_damping,
        lowest_speed=_number_or_quantity(lowest_speed),
        dynamic=True if dynamic else None,
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
