"""Gains in files, by their ending; read back they run identically.

Every file says the sampling period, the units and two check values: the CRC-32 of all numbers as
little-endian doubles, and the commands that answer a stated test input.
"""

import csv
import io
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from jaxbeam.files.export.gains import ARRAYS, Gains
from jaxbeam.files.export.header import header

FORMAT = "jaxbeam gains 3"
COEFFICIENTS = ("b0", "b1", "b2", "a0", "a1", "a2")


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
    found = gains.checksum, gains.test_command.tolist(), gains.test_estimate.tolist()
    if found != checks:
        raise ValueError(f"{path}: the numbers do not give the check values; the file was changed")
    return gains


def _restored(about: dict[str, Any], arrays: dict[str, Any]) -> tuple[Gains, tuple]:
    """The gains of a file, and the check values in it."""
    columns, commands = (
        tuple((signal, unit) for signal, unit in about[name]) for name in ("columns", "commands")
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
        about["period_s"],
        about["crossing_s"],
        math.inf if about["fade_s"] is None else about["fade_s"],
        about["between"],
        columns,
        commands,
        np.reshape(arrays["estimator"], about["estimator_shape"]),
        about["readings"],
    )
    return gains, (about["crc32"], about["test_command"], about["test_estimate"])


def _about(gains: Gains) -> dict[str, Any]:
    """What a file says beside the numbers."""
    return {
        "format": FORMAT,
        "law": "u = -K(mass, speed, share) z",
        "period_s": gains.period,
        "crossing_s": gains.crossing,
        "fade_s": gains.fade if math.isfinite(gains.fade) else None,
        "between": gains.between,
        "masses_kg": gains.masses.tolist(),
        "speeds_m_per_s": gains.speeds.tolist(),
        "columns": gains.columns,
        "commands": gains.commands,
        "filters": ["sensor", *COEFFICIENTS],
        "test_input": gains.test_input,
        "test_command": gains.test_command.tolist(),
        "estimator": "[[A, B, B', L], [C, 0, D, o]]: x = A x + B u + B' u'; x += L (y-C x-D u'-o)",
        "readings": gains.readings,
        "estimator_shape": gains.estimator.shape,
        "test_estimate": gains.test_estimate.tolist(),
        "crc32": gains.checksum,
    }


def _csv(gains: Gains) -> bytes:
    """A comment with all that is said, then rows: what it is, mass and speed, share, and numbers.

    In a row of a filter the sensor is in the place of the share.
    """
    pairs = [f"K {u}/{z} [{a}/({b})]" for u, a in gains.commands for z, b in gains.columns]
    rows = [["row", "mass [kg]", "speed [m/s]", "share or sensor", *pairs]]
    for i, mass in enumerate(gains.masses):
        for j, speed in enumerate(gains.speeds):
            whole = zip(gains.shares, gains.table[i, j], strict=True)
            rows += [["gain", mass, speed, share, *gain.ravel()] for share, gain in whole]
            rows += [["rest", mass, speed, "", *gains.rest[i, j].ravel()]]
    rows += [["filter", "", "", *row] for row in gains.filters]
    rows += [["estimator", "", "", "", *row] for row in gains.estimator]
    lines = [f"# {json.dumps(_about(gains))}"]
    lines += [",".join(map(_text, row)) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def _text(entry: Any) -> str:
    return entry if isinstance(entry, str) else repr(float(entry))


def _from_csv(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    first, _, *lines = path.read_text(encoding="utf-8").splitlines()
    about = json.loads(first.removeprefix("# "))
    found = {"gain": [], "rest": [], "filter": [], "estimator": []}
    for kind, _, _, *entries in csv.reader(lines):
        found[kind].append([float(entry) for entry in entries if entry])
    designs = len(about["masses_kg"]) * len(about["speeds_m_per_s"])
    arrays = {
        "masses": about["masses_kg"],
        "speeds": about["speeds_m_per_s"],
        "shares": [row[0] for row in found["gain"][: len(found["gain"]) // designs]],
        "table": [row[1:] for row in found["gain"]],
        "rest": found["rest"],
        "filters": found["filter"],
        "estimator": found["estimator"],
    }
    return about, arrays


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
    return header(gains, _about(gains)).encode()


WRITERS = {".csv": _csv, ".mat": _mat, ".tdms": _tdms, ".h": _header}
READERS = {".csv": _from_csv, ".mat": _from_mat, ".tdms": _from_tdms}
