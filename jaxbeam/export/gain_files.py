"""Files of gains in the format of their suffix, written and read back without loss; C headers.

Each file holds the sampling period, the units and the check values: the CRC-32 of all numbers as
little-endian doubles, and commands and estimate for a stated input. A C header has arrays, and the
functions `jaxbeam_command` and `jaxbeam_estimate`.
"""

import csv
import io
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from jaxbeam.case.arguments import checks_classes
from jaxbeam.export.gains import ARRAYS, Gains
from jaxbeam.files.tables import as_text_cell
from jaxbeam.runtime.input_file import check_input, describe_content
from jaxbeam.runtime.output_file import whole_file


def c_header(gains: Gains, metadata: dict[str, Any]) -> str:
    """Text of a C header with the gains, and the metadata in a comment at its top.

    Its functions are those of `Gains.command` and `Gains.estimate`.
    """
    comment = json.dumps(metadata, indent=1).replace("*/", "* /")
    masses, speeds, points, actuators, columns = gains.table.shape
    test = gains.test_input
    macros = {"MASSES": masses, "SPEEDS": speeds, "POINTS": points}
    macros |= {"ACTUATORS": actuators, "COLUMNS": columns}
    macros |= {"NEAREST": int(gains.interpolation == "nearest")}
    macros |= {"FILTERS": len(gains.filters), "CHECK_CRC32": f"{gains.checksum}u"}
    if gains.estimator_size:
        macros |= {"ESTIMATED": gains.estimator_size, "READINGS": gains.reading_count}
    macros |= {"PERIOD": repr(gains.period), "CROSSING": repr(gains.crossing_time)}
    macros |= {"FADE": repr(gains.decay_time)} if math.isfinite(gains.decay_time) else {}
    macros |= {f"TEST_{name.upper()}": repr(test[name]) for name in ("share", "mass", "speed")}
    defines = [f"#define JAXBEAM_{name} {value}" for name, value in macros.items()]
    arrays = {name: getattr(gains, name) for name in ARRAYS}
    arrays |= {"test_command": gains.test_command, "test_estimate": gains.test_estimate}
    texts = [_c_array(name, numbers) for name, numbers in arrays.items() if numbers.size]
    return "\n".join([f"/* {comment} */", *defines, *texts, C_FUNCTIONS])


def _c_array(name: str, numbers: np.ndarray) -> str:
    values = ", ".join(repr(float(number)) for number in np.ravel(numbers))
    return f"static const double jaxbeam_{name}[] = {{{values}}};"


C_FUNCTIONS = """
#ifdef JAXBEAM_FADE
#include <math.h>
#endif

/* Index of the last point of a grid that is not above a value, and the fraction to the next. */
static inline int jaxbeam_index(const double *grid, int count, double value, double *fraction)
{
    int i = 0;
    *fraction = 0.0;
    while (i + 1 < count && grid[i + 1] <= value) i++;
    if (i + 1 < count && value > grid[i]) *fraction = (value - grid[i]) / (grid[i + 1] - grid[i]);
    return i;
}

/* Two designs of a grid and their weights, for the interpolation at a value. */
static inline void jaxbeam_designs(
    const double *grid, int count, double value, int design[2], double weight[2])
{
    double fraction, distance, smallest = -1.0;
    int i = jaxbeam_index(grid, count, value, &fraction);
    design[0] = i;
    design[1] = i + 1 < count ? i + 1 : i;
    weight[0] = 1.0 - fraction;
    weight[1] = fraction;
    if (!JAXBEAM_NEAREST) return;
    weight[0] = 1.0;
    weight[1] = 0.0;
    for (i = 0; i < count; i++) {
        distance = value > grid[i] ? value - grid[i] : grid[i] - value;
        if (smallest >= 0.0 && distance >= smallest) continue;
        smallest = distance;
        design[0] = design[1] = i;
    }
}

/* Commands for a state at a share of the crossing (negative before the entry, 1 or more after the
   exit, which was since_exit s ago), for a load of this mass (kg) and speed (m/s). Results agree
   with Gains.command of jaxbeam to the last bit if compiled with -ffp-contract=off. */
static inline void jaxbeam_command(double mass, double speed, double share, double since_exit,
                                   const double *state, double *command)
{
    const int size = JAXBEAM_ACTUATORS * JAXBEAM_COLUMNS;
    double mass_weight[2], speed_weight[2], fraction, decay = 1.0;
    int mass_index[2], speed_index[2], point, next, after_exit, a, c, i, j, k, design;
    jaxbeam_designs(jaxbeam_masses, JAXBEAM_MASSES, mass, mass_index, mass_weight);
    jaxbeam_designs(jaxbeam_speeds, JAXBEAM_SPEEDS, speed, speed_index, speed_weight);
    point = jaxbeam_index(jaxbeam_shares, JAXBEAM_POINTS, share, &fraction);
    next = point + 1 < JAXBEAM_POINTS ? point + 1 : point;
    after_exit = share >= 1.0 && JAXBEAM_POINTS > 1;
#ifdef JAXBEAM_FADE
    if (after_exit) decay = exp(-since_exit / JAXBEAM_FADE);
#else
    (void)since_exit;
#endif
    for (a = 0; a < JAXBEAM_ACTUATORS; a++) {
        command[a] = 0.0;
        for (c = 0; c < JAXBEAM_COLUMNS && share >= 0.0; c++) {
            double gain = 0.0;
            k = a * JAXBEAM_COLUMNS + c;
            for (i = 0; i < 2; i++) {
                for (j = 0; j < 2; j++) {
                    const double *table, *rest;
                    double low, value;
                    design = mass_index[i] * JAXBEAM_SPEEDS + speed_index[j];
                    table = jaxbeam_table + design * JAXBEAM_POINTS * size;
                    rest = jaxbeam_rest + design * size;
                    low = table[point * size + k];
                    value = low + fraction * (table[next * size + k] - low);
                    if (after_exit) value = decay * rest[k];
                    gain += mass_weight[i] * speed_weight[j] * value;
                }
            }
            command[a] -= gain * state[c];
        }
    }
}

#ifdef JAXBEAM_ESTIMATED
/* State estimate at a sample, in place of that at the previous sample, for the commands that acted
   until the previous sample and until this one, and the readings. Zero initially; the first states
   are those of the gains. */
static inline void jaxbeam_estimate(double *state, const double *previous_command,
                                    const double *current_command, const double *readings)
{
    const int size = JAXBEAM_ESTIMATED, inputs = JAXBEAM_ACTUATORS;
    const int width = size + 2 * inputs + JAXBEAM_READINGS;
    double prior[JAXBEAM_ESTIMATED], innovation[JAXBEAM_READINGS];
    const double *row;
    int i, j;
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * width;
        prior[i] = 0.0;
        for (j = 0; j < size; j++) prior[i] += row[j] * state[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + j] * previous_command[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + inputs + j] * current_command[j];
    }
    for (i = 0; i < JAXBEAM_READINGS; i++) {
        row = jaxbeam_estimator + (size + i) * width;
        innovation[i] = readings[i] - row[size + 2 * inputs];
        for (j = 0; j < size; j++) innovation[i] -= row[j] * prior[j];
        for (j = 0; j < inputs; j++) innovation[i] -= row[size + inputs + j] * current_command[j];
    }
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * width + size + 2 * inputs;
        state[i] = prior[i];
        for (j = 0; j < JAXBEAM_READINGS; j++) state[i] += row[j] * innovation[j];
    }
}
#endif
"""


FORMAT = "jaxbeam gains 3"
SECTION_COEFFICIENTS = ("b0", "b1", "b2", "a0", "a1", "a2")


@checks_classes
def write_gains(gains: Gains, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write gains to a file with the suffix .csv, .mat, .tdms or .h, which selects the format.

    Raises ValueError for another suffix, FileExistsError if the file exists and `overwrite` is not
    set, ImportError for .tdms without the package npTDMS.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ValueError(f"{path}: gains are written to {', '.join(WRITERS)}")
    content = WRITERS[path.suffix](gains)
    with whole_file(path, overwrite) as partial:
        partial.write_bytes(content)


@checks_classes
def read_gains(path: str | os.PathLike) -> Gains:
    """Gains of a .csv, .mat or .tdms file, with the same numbers to the last bit.

    Raises ValueError for another suffix, a file that `write_gains` did not write, and numbers that
    contradict the check values of the file; ImportError for .tdms without the package npTDMS.
    """
    path = Path(path)
    if path.suffix not in READERS:
        raise ValueError(f"{path}: gains are read from {', '.join(READERS)}")
    check_input(path, "gains")
    try:
        gains, check_values = _gains_from_file(*READERS[path.suffix](path))
    except ImportError:
        raise
    except Exception:  # readers raise many types for damaged files
        raise ValueError(
            f"{path}: not a file of gains written by jaxbeam, or damaged: it is"
            f" {describe_content(path.read_bytes()[:4096])}"
        ) from None
    computed = gains.checksum, gains.test_command.tolist(), gains.test_estimate.tolist()
    if computed != check_values:
        raise ValueError(
            f"{path}: the numbers contradict the check values; the file was changed: export it anew"
        )
    return gains


def _gains_from_file(metadata: dict[str, Any], arrays: dict[str, Any]) -> tuple[Gains, tuple]:
    """Gains of a file, and its check values."""
    columns, commands = (
        tuple((signal, unit) for signal, unit in metadata[name]) for name in ("columns", "commands")
    )
    masses, speeds, shares = (np.ravel(arrays[name]) for name in ARRAYS[:3])
    grid, gain = (masses.size, speeds.size), (len(commands), len(columns))
    gains = Gains(
        masses,
        speeds,
        shares,
        np.reshape(arrays["table"], (*grid, shares.size, *gain)),
        np.reshape(arrays["rest"], (*grid, *gain)),
        np.reshape(arrays["filters"], (-1, 7)),
        metadata["period_s"],
        metadata["crossing_s"],
        math.inf if metadata["fade_s"] is None else metadata["fade_s"],
        metadata["between"],
        columns,
        commands,
        np.reshape(arrays["estimator"], metadata["estimator_shape"]),
        metadata["readings"],
    )
    return gains, (metadata["crc32"], metadata["test_command"], metadata["test_estimate"])


def _metadata(gains: Gains) -> dict[str, Any]:
    """Metadata of a file of gains."""
    return {
        "format": FORMAT,
        "law": "u = -K(mass, speed, share) z",
        "period_s": gains.period,
        "crossing_s": gains.crossing_time,
        "fade_s": gains.decay_time if math.isfinite(gains.decay_time) else None,
        "between": gains.interpolation,
        "masses_kg": gains.masses.tolist(),
        "speeds_m_per_s": gains.speeds.tolist(),
        "columns": gains.columns,
        "commands": gains.commands,
        "filters": ["sensor", *SECTION_COEFFICIENTS],
        "test_input": gains.test_input,
        "test_command": gains.test_command.tolist(),
        "estimator": "[[A, B, B', L], [C, 0, D, o]]: x = A x + B u + B' u'; x += L (y-C x-D u'-o)",
        "readings": gains.reading_count,
        "estimator_shape": gains.estimator.shape,
        "test_estimate": gains.test_estimate.tolist(),
        "crc32": gains.checksum,
    }


def _to_csv(gains: Gains) -> bytes:
    """Metadata as a comment, then rows: name, mass, speed, share (or sensor index), numbers."""
    pairs = [f"K {u}/{z} [{a}/({b})]" for u, a in gains.commands for z, b in gains.columns]
    rows = [["row", "mass [kg]", "speed [m/s]", "share or sensor", *pairs]]
    for i, mass in enumerate(gains.masses):
        for j, speed in enumerate(gains.speeds):
            gains_by_share = zip(gains.shares, gains.table[i, j], strict=True)
            rows += [["gain", mass, speed, share, *gain.ravel()] for share, gain in gains_by_share]
            rows += [["rest", mass, speed, "", *gains.rest[i, j].ravel()]]
    rows += [["filter", "", "", *row] for row in gains.filters]
    rows += [["estimator", "", "", "", *row] for row in gains.estimator]
    text = io.StringIO()
    # A comma in the name of a body would begin a cell, which may be a formula.
    metadata = re.sub(
        r'"(?:[^"\\]|\\.)*"',
        lambda name: re.sub(r",(?=\s*[=+@-])", r"\\u002c", name[0]),
        json.dumps(_metadata(gains)),
    )
    text.write(f"# {metadata}\n")
    csv.writer(text, lineterminator="\n").writerows([map(_csv_cell, row) for row in rows])
    return text.getvalue().encode()


def _csv_cell(entry: Any) -> str:
    return as_text_cell(entry) if isinstance(entry, str) else repr(float(entry))


def _from_csv(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    first, _, *lines = path.read_text(encoding="utf-8").splitlines()
    metadata = json.loads(first.removeprefix("# "))
    rows_by_name = {"gain": [], "rest": [], "filter": [], "estimator": []}
    for kind, _, _, *entries in csv.reader(lines):
        rows_by_name[kind].append([float(entry) for entry in entries if entry])
    designs = len(metadata["masses_kg"]) * len(metadata["speeds_m_per_s"])
    arrays = {
        "masses": metadata["masses_kg"],
        "speeds": metadata["speeds_m_per_s"],
        "shares": [row[0] for row in rows_by_name["gain"][: len(rows_by_name["gain"]) // designs]],
        "table": [row[1:] for row in rows_by_name["gain"]],
        "rest": rows_by_name["rest"],
        "filters": rows_by_name["filter"],
        "estimator": rows_by_name["estimator"],
    }
    return metadata, arrays


def _to_mat(gains: Gains) -> bytes:
    content = {name: getattr(gains, name) for name in ARRAYS}
    file = io.BytesIO()
    scipy.io.savemat(
        file, content | {"period": gains.period, "about": json.dumps(_metadata(gains))}
    )
    return file.getvalue()


def _from_mat(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    content = scipy.io.loadmat(path)
    return json.loads(content["about"].item()), content


def _to_tdms(gains: Gains) -> bytes:
    """TDMS file with a channel for each array, in C order, in the group "gains"."""
    nptdms = _nptdms()
    file = io.BytesIO()
    root = nptdms.RootObject({"about": json.dumps(_metadata(gains)), "period_s": gains.period})
    channels = [nptdms.ChannelObject("gains", n, np.ravel(getattr(gains, n))) for n in ARRAYS]
    with nptdms.TdmsWriter(file) as writer:
        writer.write_segment([root, *channels])
    return file.getvalue()


def _from_tdms(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    content = _nptdms().TdmsFile.read(path)
    arrays = {name: np.asarray(content["gains"][name][:], float) for name in ARRAYS}
    return json.loads(content.properties["about"]), arrays


def _nptdms():
    try:
        import nptdms  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError(
            "npTDMS is not installed; install jaxbeam with the extra 'tdms':"
            " pip install 'jaxbeam[tdms]'"
        ) from None
    return nptdms


def _to_header(gains: Gains) -> bytes:
    return c_header(gains, _metadata(gains)).encode()


WRITERS = {".csv": _to_csv, ".mat": _to_mat, ".tdms": _to_tdms, ".h": _to_header}
READERS = {".csv": _from_csv, ".mat": _from_mat, ".tdms": _from_tdms}
