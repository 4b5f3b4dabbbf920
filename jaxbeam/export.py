"""Gains and filters for real controllers, as CSV, .mat, TDMS or a C header; and read back.

Every file says the sampling period, the units and two check values: the CRC-32 of all numbers as
little-endian doubles, and the commands that answer a stated test input.
"""

import csv
import dataclasses
import io
import json
import os
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.io

from jaxbeam.case import Case
from jaxbeam.checks import check
from jaxbeam.compiling import compiled
from jaxbeam.control import DiscreteLQR, StateFeedback
from jaxbeam.control.lqr import LQR, AbstractScheduledRegulator, Schedule
from jaxbeam.control.scheduled import ScheduledLQR
from jaxbeam.fields import known
from jaxbeam.modes import lay_out
from jaxbeam.sensing import design
from jaxbeam.statespace import state_space

TEST_SHARE = 0.37  # of the crossing; the test state has 1, 1/2, 1/3, ... in its columns
COEFFICIENTS = ("b0", "b1", "b2", "a0", "a1", "a2")
ARRAYS = ("shares", "table", "rest", "filters")


@dataclasses.dataclass(frozen=True, eq=False)
class Gains:
    """A gain table as a controller runs it: u = -K(share) z, K linear between the `shares`.

    `table` (share, actuator, column) is for `crossing` s from the entry of the first load to the
    exit of the last, a crossing of another length stretches it; `rest` (actuator, column) is from
    the exit on. A constant gain is a table of one share, with a crossing of 0 s. `columns` and
    `commands` are (name, unit). Rows of `filters` are the index of a sensor and its section
    b0, b1, b2, a0, a1, a2.
    """

    shares: np.ndarray
    table: np.ndarray
    rest: np.ndarray
    filters: np.ndarray
    period: float
    crossing: float
    columns: tuple[tuple[str, str], ...]
    commands: tuple[tuple[str, str], ...]

    def command(self, state: np.ndarray, share: float = 0.0) -> np.ndarray:
        """Commands for a state, in the order of `columns`, at a share of the crossing.

        Zero before the entry. Products are added one by one, as the C header does, so results
        agree to the last bit.
        """
        if share < 0:
            return np.zeros(len(self.commands))
        gain = self.rest
        if share < 1 or self.shares.size == 1:
            i = int(np.clip(np.searchsorted(self.shares, share, "right") - 1, 0, None))
            gain = self.table[i]
            if i + 1 < self.shares.size:
                part = (share - self.shares[i]) / (self.shares[i + 1] - self.shares[i])
                gain = gain + part * (self.table[i + 1] - gain)
        total = np.zeros(len(self.commands))
        for column, value in zip(gain.T, np.asarray(state, float), strict=True):
            total = total - column * value
        return total

    @property
    def test_command(self) -> np.ndarray:
        """The commands that answer the test state 1, 1/2, 1/3, ... at the test share."""
        return self.command(1 / np.arange(1.0, len(self.columns) + 1), TEST_SHARE)

    @property
    def checksum(self) -> int:
        """CRC-32 of period, crossing, shares, table, rest and filters as little-endian doubles."""
        parts = [[self.period, self.crossing], *(getattr(self, name) for name in ARRAYS)]
        return zlib.crc32(b"".join(np.ravel(part).astype("<f8").tobytes() for part in parts))


def export_gains(case: Case, points: int = 1001) -> Gains:
    """The gains of a case's controller, designed, and the digital filters of its sensors.

    Gains that change over the crossing are tabulated at so many `points`. Raises ValueError for a
    faulty case, a controller without a period, and one that is no table of gains.
    """
    check(case)
    law = case.controller
    tabled = isinstance(law, AbstractScheduledRegulator) and not isinstance(law, ScheduledLQR)
    if not (tabled or isinstance(law, LQR | DiscreteLQR | StateFeedback)):
        raise ValueError(
            "controller.kind cannot be exported: tables are made of 'state', 'lqr', 'dlqr',"
            " 'lqr-finite', 'lqr-step' and 'lqr-augmented'"
        )
    if law.period is None:
        raise ValueError("controller.period is missing: a real controller samples; give its period")
    if getattr(law, "after", "none") == "fade":
        raise ValueError("controller.after cannot be 'fade' in a table; take 'hold' or 'none'")
    if points < 2:
        raise ValueError(f"a table needs at least two points, not {points}")
    shares = np.linspace(0, 1, points) if tabled else np.zeros(1)
    plant, table, rest, crossing = _designed(case, lay_out(case), shares)
    columns, commands = plant.states, plant.inputs
    more = table.shape[2] - len(columns)
    if more and tabled:
        columns += tuple((f"load_{i}", "N") for i in range(more))
    elif more:
        columns += tuple((f"last_{name}", unit) for name, unit in commands)
    period = float(known(law.period))
    filters = np.zeros((0, 7))
    for i, sensor in enumerate(case.sensors):
        sections = design(sensor, period)
        if sections is not None:
            rows = np.insert(np.asarray(sections), 0, i, axis=1)
            filters = np.concatenate([filters, rows])
    return Gains(
        shares,
        np.asarray(table),
        np.asarray(rest),
        filters,
        period,
        float(crossing),
        tuple(tuple(column) for column in columns),
        tuple(tuple(command) for command in commands),
    )


@compiled
def _designed(case: Case, layout, shares):
    """The plant designed for, gains at shares of the crossing and after, and how long it is (s)."""
    model, law = state_space(case, layout=layout), case.controller
    designed = law.believed(model)
    memory = law.gain if isinstance(law, StateFeedback) else law.prepare(model, designed)
    if isinstance(memory, Schedule):
        table = jax.vmap(memory.table)(shares)
        return designed.unloaded, table, memory.rest, memory.end - memory.start
    return designed.unloaded, memory[None], memory, 0.0


def write_gains(gains: Gains, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write gains to a file; its ending says how: .csv, .mat, .tdms or .h.

    Raises ValueError for another ending, FileExistsError if the file exists and `overwrite` is not
    set, ImportError for .tdms without the package npTDMS.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ValueError(f"{path}: gains are written to {', '.join(WRITERS)}")
    content = WRITERS[path.suffix](gains)
    try:
        with open(path, "wb" if overwrite else "xb") as file:
            file.write(content)
    except FileExistsError:
        raise FileExistsError(
            f"{path} exists already; choose another name, or overwrite it"
        ) from None


def read_gains(path: str | os.PathLike) -> Gains:
    """Read gains from a .csv, .mat or .tdms file; they run as those that were written, bit for bit.

    Raises ValueError for another ending, a file of something else, and numbers that do not give the
    check values in the file; ImportError for .tdms without the package npTDMS.
    """
    path = Path(path)
    if path.suffix not in READERS:
        raise ValueError(f"{path}: gains are read from {', '.join(READERS)}")
    try:
        gains, checks = _restored(*READERS[path.suffix](path))
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: this is no file of gains that jaxbeam wrote") from None
    if (gains.checksum, gains.test_command.tolist()) != checks:
        raise ValueError(f"{path}: the numbers do not give the check values; the file was changed")
    return gains


def _restored(about: dict[str, Any], arrays: dict[str, Any]) -> tuple[Gains, tuple]:
    """The gains of a file, and the check values in it."""
    columns, commands = (
        tuple((signal, unit) for signal, unit in about[name]) for name in ("columns", "commands")
    )
    table = np.reshape(arrays["table"], (-1, len(commands), len(columns)))
    gains = Gains(
        np.ravel(arrays["shares"]),
        table,
        np.reshape(arrays["rest"], table.shape[1:]),
        np.reshape(arrays["filters"], (-1, 7)),
        about["period_s"],
        about["crossing_s"],
        columns,
        commands,
    )
    return gains, (about["crc32"], about["test_command"])


def _about(gains: Gains) -> dict[str, Any]:
    """What a file says beside the numbers."""
    return {
        "format": "jaxbeam gains 1",
        "law": "u = -K(share) z",
        "period_s": gains.period,
        "crossing_s": gains.crossing,
        "columns": gains.columns,
        "commands": gains.commands,
        "filters": ["sensor", *COEFFICIENTS],
        "test_input": f"z = 1, 1/2, 1/3, ...; share {TEST_SHARE}",
        "test_command": gains.test_command.tolist(),
        "crc32": gains.checksum,
    }


def _csv(gains: Gains) -> bytes:
    """A comment with all that is said, then rows: what it is, share or sensor, and numbers."""
    pairs = [f"K {u}/{z} [{a}/({b})]" for u, a in gains.commands for z, b in gains.columns]
    rows = [["row", "share or sensor", *pairs]]
    whole = zip(gains.shares, gains.table, strict=True)
    rows += [["gain", share, *gain.ravel()] for share, gain in whole]
    rows += [["rest", "", *gains.rest.ravel()]]
    rows += [["filter", *row] for row in gains.filters]
    lines = [f"# {json.dumps(_about(gains))}"]
    lines += [",".join(map(_text, row)) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def _text(entry: Any) -> str:
    return entry if isinstance(entry, str) else repr(float(entry))


def _from_csv(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    first, _, *lines = path.read_text(encoding="utf-8").splitlines()
    found = {"gain": [], "rest": [], "filter": []}
    for kind, *entries in csv.reader(lines):
        found[kind].append([float(entry) for entry in entries if entry])
    arrays = {
        "shares": [row[0] for row in found["gain"]],
        "table": [row[1:] for row in found["gain"]],
        "rest": found["rest"],
        "filters": found["filter"],
    }
    return json.loads(first.removeprefix("# ")), arrays


def _mat(gains: Gains) -> bytes:
    content = {name: getattr(gains, name) for name in ARRAYS}
    file = io.BytesIO()
    scipy.io.savemat(file, content | {"period": gains.period, "about": json.dumps(_about(gains))})
    return file.getvalue()


def _from_mat(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    content = scipy.io.loadmat(path)
    return json.loads(content["about"].item()), content


def _tdms(gains: Gains) -> bytes:
    """The group "gains" with a channel for each array, row after row."""
    nptdms = _nptdms()
    file = io.BytesIO()
    root = nptdms.RootObject({"about": json.dumps(_about(gains)), "period_s": gains.period})
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


def _header(gains: Gains) -> bytes:
    """Plain C: arrays, and a function that gives the commands."""
    about = json.dumps(_about(gains), indent=1).replace("*/", "* /")
    points, actuators, columns = gains.table.shape
    sizes = {"POINTS": points, "ACTUATORS": actuators, "COLUMNS": columns}
    sizes |= {"FILTERS": len(gains.filters), "CHECK_CRC32": f"{gains.checksum}u"}
    sizes |= {"PERIOD": repr(gains.period), "CROSSING": repr(gains.crossing)}
    sizes |= {"TEST_SHARE": repr(TEST_SHARE)}
    defines = [f"#define JAXBEAM_{name} {value}" for name, value in sizes.items()]
    arrays = {"shares": gains.shares, "table": gains.table, "rest": gains.rest}
    arrays |= {"filters": gains.filters} if gains.filters.size else {}
    arrays |= {"test_command": gains.test_command}
    texts = [
        f"static const double jaxbeam_{name}[] = {{{', '.join(map(_text, np.ravel(numbers)))}}};"
        for name, numbers in arrays.items()
    ]
    return "\n".join([f"/* {about} */", *defines, *texts, C_FUNCTION]).encode()


C_FUNCTION = """
/* Commands for a state and a share of the crossing. Compile with -ffp-contract=off for results
   that agree to the last bit. */
static inline void jaxbeam_command(double share, const double *state, double *command)
{
    const int size = JAXBEAM_ACTUATORS * JAXBEAM_COLUMNS;
    const double *low = jaxbeam_rest, *high = jaxbeam_rest;
    double part = 0.0;
    int i = 0, a, c;
    if (share < 1.0 || JAXBEAM_POINTS == 1) {
        while (i + 1 < JAXBEAM_POINTS && jaxbeam_shares[i + 1] <= share) i++;
        low = high = jaxbeam_table + i * size;
        if (i + 1 < JAXBEAM_POINTS) {
            high = low + size;
            part = (share - jaxbeam_shares[i]) / (jaxbeam_shares[i + 1] - jaxbeam_shares[i]);
        }
    }
    for (a = 0; a < JAXBEAM_ACTUATORS; a++) {
        command[a] = 0.0;
        for (c = 0; c < JAXBEAM_COLUMNS && share >= 0.0; c++) {
            int k = a * JAXBEAM_COLUMNS + c;
            command[a] -= (low[k] + part * (high[k] - low[k])) * state[c];
        }
    }
}
"""

WRITERS = {".csv": _csv, ".mat": _mat, ".tdms": _tdms, ".h": _header}
READERS = {".csv": _from_csv, ".mat": _from_mat, ".tdms": _from_tdms}
