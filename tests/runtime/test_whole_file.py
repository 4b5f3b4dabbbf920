"""Files appear whole or not at all."""

import ast
import errno
import os
import re
import resource
import signal

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.files.matrices import write_state_space
from jaxbeam.files.tables import write_table
from jaxbeam.runtime.output_file import whole_file
from tests.modules import module_files, parse
from tuning.checkpoint import save


def test_a_write_that_stops_leaves_what_was_there(tmp_path):
    path = tmp_path / "fit.npz"
    path.write_text("precious")
    with pytest.raises(ZeroDivisionError), whole_file(path, overwrite=True) as beside:
        beside.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "precious" and list(tmp_path.iterdir()) == [path]


def test_what_is_there_is_refused_before_and_after(tmp_path):
    path = tmp_path / "case.toml"
    refused = pytest.raises(FileExistsError, match=r"case.toml exists already")
    with refused, whole_file(path) as beside:
        beside.write_text("ours")
        path.write_text("of another process")
    with pytest.raises(FileExistsError), whole_file(path):
        pytest.fail("nothing is computed")
    assert path.read_text() == "of another process" and list(tmp_path.iterdir()) == [path]


def test_a_folder_takes_the_place_of_a_folder_and_links_stay(tmp_path):
    place, link = tmp_path / "runs.zarr", tmp_path / "link.zarr"
    place.mkdir()
    (place / "old").touch()
    link.symlink_to(place)
    with whole_file(link, overwrite=True) as beside:
        beside.mkdir()
        (beside / "new").touch()
    assert link.is_symlink() and [path.name for path in place.iterdir()] == ["new"]


def test_a_link_to_a_file_without_an_ending_keeps_both(tmp_path):
    place, link = tmp_path / "stored", tmp_path / "x.csv"
    place.touch()
    link.symlink_to(place)
    write_table(link, {"x (m)": np.arange(2.0)}, overwrite=True)
    assert link.is_symlink() and place.read_text().splitlines()[0] == "x (m)"
    assert sorted(tmp_path.iterdir()) == [place, link]


def test_no_file_takes_the_place_of_a_pipe_or_a_device(tmp_path):
    place, link = tmp_path / "pipe", tmp_path / "x.csv"
    os.mkfifo(place)
    link.symlink_to(place)
    for path in (link, place):
        said = f"cannot write {re.escape(str(path))}: it is a device or a pipe"
        with pytest.raises(OSError, match=said), whole_file(path, overwrite=True):
            pytest.fail("nothing is computed")
    assert place.is_fifo() and link.is_symlink()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "no space left on device"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "disk quota exceeded"),
        (PermissionError(errno.EACCES, "Permission denied", ".x.123.csv"), "permission denied"),
        (OSError("error of a library"), "error of a library"),
    ],
)
def test_an_error_names_the_file_that_the_user_gave(tmp_path, monkeypatch, error, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError) as raised, whole_file("x.csv") as beside:
        beside.write_text("half")
        raise error
    assert str(raised.value) == f"cannot write x.csv: {said}" and raised.value.errno == error.errno
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["", "/", "."])
def test_a_file_without_a_name_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for write in (WRITERS["record.csv"], WRITERS["case.toml"]):
        with pytest.raises(ValueError, match="is no name of a file to write"):
            write(name)


WRITERS = {
    "record.csv": lambda path: jb.save(RECORD, path),
    "record.xlsx": lambda path: jb.save(RECORD, path),
    "record.mat": lambda path: jb.save(RECORD, path),
    "record.parquet": lambda path: jb.save(RECORD, path),
    "record.nc": lambda path: jb.save(RECORD, path),
    "record.zarr": lambda path: jb.save(RECORD, path),
    "case.toml": lambda path: jb.save_case(CASE, path),
    "system.mat": lambda path: write_state_space(jb.state_space(CASE).at(0.0), path),
    "system.npz": lambda path: write_state_space(jb.state_space(CASE).at(0.0), path),
    "system.json": lambda path: write_state_space(jb.state_space(CASE).at(0.0), path),
    "system.csv": lambda path: write_state_space(jb.state_space(CASE).at(0.0), path),
    "state.npz": lambda path: save(path, "", {"a": np.arange(3)}),
}
CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535), sensors=[jb.Sensor(0.3)]
)
RECORD = jb.modes(CASE)


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_names_a_missing_folder(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError) as raised:
        WRITERS[name](f"nodir/{name}")
    assert str(raised.value) == f"cannot write nodir/{name}: there is no folder nodir"


@pytest.mark.parametrize("name", WRITERS)
def test_every_writer_names_its_file_on_a_full_disk(tmp_path, monkeypatch, name):
    """Sizes of files are limited, as `ulimit -f` does, in place of a full disk."""
    monkeypatch.chdir(tmp_path)
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # The sheets of a workbook are collected in a file elsewhere first, which is shorter.
    limit = 4000 if name.endswith(".xlsx") else 20
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, former[1]))
    try:
        with pytest.raises(OSError) as raised:
            WRITERS[name](name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, former)
        signal.signal(signal.SIGXFSZ, handler)
    assert str(raised.value) == f"cannot write {name}: file too large"
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_at_its_place():
    """Every call that writes a file by name is given the path `beside` its place.

    Except caches, stores of sweeps, which are written in blocks under a lock, and what the page in
    the browser writes into a temporary folder of its own.
    """
    by_themselves = "jaxbeam.runtime.", "jaxbeam.sweeps.store"
    by_themselves += "jaxbeam.app.studies", "jaxbeam.app.take_away"
    writing = {"write_text", "write_bytes", "savefig", "savez", "to_netcdf", "to_zarr", "savemat"}
    wrong = []
    for module, path in module_files().items():
        if not module.startswith(("jaxbeam", "tuning")) or module.startswith(by_themselves):
            continue
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                called = node.func
                if called.attr in writing:
                    names = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                    if not names & {"beside", "file", "self"}:
                        wrong.append(f"{module}: {ast.unparse(node)[:80]}")
    assert wrong == []
