"""Files that are read: which are refused before they are opened, and what is said of them."""

import ast
import errno
import io
import os
import re
import resource
import signal
import socket
import zipfile

import numpy as np
import pytest

import jaxbeam as jb
import tuning
from jaxbeam.export import read_gains
from jaxbeam.files.case_file import load_case_with, profile_from_file
from jaxbeam.files.tables import write_state_space, write_table
from jaxbeam.runtime import input_file
from jaxbeam.runtime.input_file import describe_content, read_input
from jaxbeam.runtime.output_file import whole_file
from tests.modules import module_files, parse
from tuning.checkpoint import read_arrays, save

BEAM = "[beam]\nlength = 25.0\nflexural_rigidity = 4.8e10\nmass_per_length = 18358.0\n"
CART = """
[[bodies]]
name = "cart"
mass = 800.0
position = 0.0
[[axles]]
body = "cart"
position = 0.0
tyre_stiffness = 1e6
"""
SECRET = "user:password-of-the-database\n"


def case_with_profile(folder, name):
    path = folder / "case.toml"
    path.write_text(f'{BEAM}[profile]\nkind = "table"\nfile = "{name}"\n')
    return path


def case_with_vehicle(folder, name, more=""):
    path = folder / "case.toml"
    path.write_text(f'{BEAM}[[loads]]\nkind = "vehicle"\nmodel = "{name}"\nspeed = 20.0\n{more}')
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Folder of the case, beside a profile, a vehicle and a secret that are outside."""
    inside = tmp_path / "cases"
    inside.mkdir()
    monkeypatch.chdir(inside)
    (tmp_path / "profile.csv").write_text("0,0\n10,0.003\n25,0\n")
    (tmp_path / "cart.toml").write_text(CART)
    (tmp_path / "secret.txt").write_text(SECRET)
    return inside


def special_file(kind, path):
    if kind == "named pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")


@pytest.mark.parametrize("kind", ["named pipe", "socket", "folder", "device"])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("case.toml", jb.load_case),
        ("road.csv", profile_from_file),
        ("cart.toml", jb.vehicles.load_vehicle),
        ("log.csv", tuning.read_log),
        ("log.h5", tuning.read_log),
        ("log.tdms", tuning.read_log),
        ("fit.npz", lambda path: read_arrays(path, "fit")),
        ("run.nc", jb.read_record),
        ("gains.csv", read_gains),
        ("cases.toml", tuning.read_load_cases),
    ],
)
def test_only_regular_files_are_opened(folder, name, read, kind):
    """A pipe would wait for ever, a device fill the memory."""
    if (name, kind) == ("run.nc", "folder"):
        pytest.skip("a folder may be a store of zarr")
    special_file(kind, folder / name)
    with pytest.raises((OSError, ValueError), match=f"{name}.*: it is a {kind}, not a regular"):
        read(folder / name)


@pytest.mark.parametrize("name", ["/dev/zero", "pipe.csv", "/dev/stdin"])
def test_a_case_names_no_device_as_its_profile(folder, name):
    os.mkfifo(folder / "pipe.csv")
    with pytest.raises((OSError, ValueError), match=r"profile.*(not below the folder|named pipe)"):
        jb.load_case(case_with_profile(folder, name))


@pytest.mark.parametrize("name", ["../profile.csv", "link.csv", "{outside}/profile.csv"])
def test_profiles_are_below_the_folder_of_the_case(folder, name):
    (folder / "link.csv").symlink_to("../profile.csv")
    path = case_with_profile(folder, name.format(outside=folder.parent))
    with pytest.raises(ValueError, match=r"profile\.file: the profile .*not below the folder"):
        jb.load_case(path)
    # Named by the user it may be anywhere.
    case = load_case_with(path, {"profile.file": "../profile.csv"})
    np.testing.assert_array_equal(case.profile.positions, [0.0, 10.0, 25.0])
    (folder / "own.csv").symlink_to("data.csv")
    (folder / "data.csv").write_text("0,0\n25,1\n")
    assert jb.load_case(case_with_profile(folder, "own.csv")).profile.positions[1] == 25.0


def test_vehicles_are_below_the_folder_of_the_file_that_names_them(folder):
    path = case_with_vehicle(folder, "../cart.toml")
    with pytest.raises(ValueError, match=r"loads\.0\.model: the vehicle file .*not below"):
        jb.load_case(path)
    case = load_case_with(path, {"loads.0.model": "../cart.toml"})
    assert case.loads[0].bodies[0].name == "cart"
    path.write_text(
        f'{BEAM}[[loads]]\nkind = "train"\nspeed = 20.0\ncoaches = [{{ model = "../cart.toml" }}]\n'
    )
    with pytest.raises(ValueError, match=r"loads\.0\.coaches\.0\.model: .*not below"):
        jb.load_case(path)


def test_vehicles_of_a_log_are_below_its_folder(folder):
    (folder / "run.csv").write_text("time [s],w [mm]\n0,0\n0.1,1\n0.2,0\n")
    load = '{}[[{}loads]]\nkind = "vehicle"\nmodel = "{}"\nspeed = 20.0\n'
    (folder / "own.toml").write_text(CART)
    for where in ("", "runs.a."):
        (folder / "run.toml").write_text(load.format("", where, "../cart.toml"))
        with pytest.raises(ValueError, match=r"loads\.0\.model: .*not below"):
            tuning.read_log(folder / "run.csv")
    (folder / "run.toml").write_text(load.format("", "", "own.toml"))
    assert tuning.read_log(folder / "run.csv").loads[0].bodies[0].name == "cart"


def test_messages_quote_nothing_of_a_file_that_is_no_profile(folder):
    (folder / "road.csv").write_text(SECRET)
    (folder / "road.toml").write_text("password = hunter2\n")
    for path in (case_with_profile(folder, "road.csv"), case_with_vehicle(folder, "road.toml")):
        with pytest.raises(ValueError) as raised:
            jb.load_case(path)
        said = str(raised.value)
        assert "line 1" in said and "password" not in said and "hunter2" not in said


def test_sizes_are_limited(folder, monkeypatch):
    """A file of /proc, which says that it is empty, is limited too."""
    path = folder / "road.csv"
    with open(path, "wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(ValueError, match=r"road.csv has 65 MB; a profile may have 64 MB"):
        profile_from_file(path)
    monkeypatch.setitem(input_file.MAX_BYTES, "log", 5)
    with pytest.raises(ValueError, match="has more|5 bytes"):
        read_input("/proc/self/status", "log")


def test_unpacked_sizes_are_limited(folder, monkeypatch):
    """A megabyte may unpack to a thousand."""
    monkeypatch.setitem(input_file.MAX_BYTES, "fit", 10**6)
    np.savez_compressed(folder / "fit.npz", values=np.zeros(10**6))
    assert (folder / "fit.npz").stat().st_size < 10**5
    with pytest.raises(ValueError, match=r"fit.npz holds .* GB, too much for a fit"):
        read_arrays(folder / "fit.npz", "fit")


GARBAGE = {
    "text": b"once upon a time\n",
    "binary data of an unknown kind": bytes(range(256)) * 4,
    "zeros only": bytes(500),
    "a PNG picture": b"\x89PNG\r\n\x1a\n" + bytes(50),
    "compressed by gzip": b"\x1f\x8b\x08" + bytes(50),
}


@pytest.mark.parametrize("content", GARBAGE)
@pytest.mark.parametrize(
    ("name", "read", "kind"),
    [
        ("x.npz", tuning.load_fit, "x.npz is no NumPy archive"),
        ("x.h5", tuning.read_log, "x.h5: this is no HDF5 file"),
        ("x.parquet", tuning.read_log, "x.parquet: this is no Parquet file"),
        ("x.tdms", tuning.read_log, "x.tdms: this is no LabVIEW"),
        ("x.mat", tuning.read_log, "x.mat: this is no MATLAB file"),
        ("x.xlsx", tuning.read_log, "x.xlsx: this is no Excel file"),
        ("x.uff", tuning.read_log, "x.uff: this is no universal file, whatever"),
        ("x.nc", tuning.read_log, "x.nc: this is no netCDF file"),
        ("x.nc", jb.read_record, "x.nc is no classic netCDF file"),
        ("x.mat", read_gains, "x.mat: not a file of gains"),
        ("x.tdms", read_gains, "x.tdms: not a file of gains"),
    ],
)
def test_garbage_is_named_as_what_it_is(folder, name, read, kind, content):
    (folder / name).write_bytes(GARBAGE[content])
    with pytest.raises(ValueError, match=rf"{kind}.*it is {content}") as raised:
        read(folder / name)
    assert "\n" not in str(raised.value)


def test_damaged_archives_and_those_of_others(folder):
    path = folder / "fit.npz"
    np.savez(path, a=np.arange(3))
    with pytest.raises(ValueError, match="is a NumPy archive, but no fit; name the .npz"):
        tuning.load_fit(path)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match="this NumPy archive is damaged or cut off"):
        tuning.load_fit(path)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("word/document.xml", "<p>")
    (folder / "run.nc").write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="is no classic netCDF file: it is a ZIP archive"):
        jb.read_record(folder / "run.nc")


def test_a_store_has_regular_files_only(folder):
    (folder / "run.zarr").mkdir()
    os.mkfifo(folder / "run.zarr" / "zarr.json")
    with pytest.raises(OSError, match="part of a store .*zarr.json: it is a named pipe"):
        jb.read_record(folder / "run.zarr")


def test_descriptions():
    assert describe_content(b"") == "empty"
    assert describe_content("Brücke".encode()) == "text"
    assert describe_content(("ü" * 5000).encode()[:4096] + b"\xc3") == "text"
    assert describe_content("Brücke".encode("cp1252") * 900) == "binary data of an unknown kind"


# Modules that open files of the package, of the system or of the cache, or after `check_input`.
BY_THEMSELVES = (
    "jaxbeam.runtime.",
    "jaxbeam.case.library.",
    "jaxbeam.benchmark.",  # of the package
    "jaxbeam.export.c_steps",
    "jaxbeam.analysis.assessment.assessment",
    "jaxbeam.cli.page.server",  # of the package
    "jaxbeam.cli.page.questions",  # what it wrote into a temporary folder
    "jaxbeam.case.loads.vehicles",
    "jaxbeam.cli.",
    "jaxbeam.export.gain_files",
    "jaxbeam.files.report",  # of the package
    "jaxbeam.files.netcdf",
    "jaxbeam.model.plausibility.check",  # of the package
    "jaxbeam.simulation.sweeps.store",  # after `check_codecs`
    "tuning.logs.readers.table",
    "tuning.logs.readers.tdms",
)


def test_no_other_module_opens_files_to_read():
    wrong = []
    for module, path in module_files().items():
        if not module.startswith(("jaxbeam", "tuning")) or module.startswith(BY_THEMSELVES):
            continue
        for node in ast.walk(parse(path)):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            modes = [one.value for one in node.args if isinstance(one, ast.Constant)]
            writes = name == "open" and any(set(str(mode)) & set("wax") for mode in modes)
            if name in ("read_text", "read_bytes", "open") and not writes:
                wrong.append(f"{module}: {ast.unparse(node)[:80]}")
    helpers = ("read_bytes(path", "read_text(path")  # those of `tuning.logs.readers.table`
    assert [one for one in wrong if not one.partition(": ")[2].startswith(helpers)] == []


# Files appear whole or not at all.


def test_a_write_that_stops_leaves_what_was_there(tmp_path):
    path = tmp_path / "fit.npz"
    path.write_text("precious")
    with pytest.raises(ZeroDivisionError), whole_file(path, overwrite=True) as partial:
        partial.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "precious" and list(tmp_path.iterdir()) == [path]


def test_what_is_there_is_refused_before_and_after(tmp_path):
    path = tmp_path / "case.toml"
    refused = pytest.raises(FileExistsError, match=r"case.toml exists already")
    with refused, whole_file(path) as partial:
        partial.write_text("ours")
        path.write_text("of another process")
    with pytest.raises(FileExistsError), whole_file(path):
        pytest.fail("nothing is computed")
    assert path.read_text() == "of another process" and list(tmp_path.iterdir()) == [path]


def test_a_folder_takes_the_place_of_a_folder_and_links_stay(tmp_path):
    place, link = tmp_path / "runs.zarr", tmp_path / "link.zarr"
    place.mkdir()
    (place / "zarr.json").touch()
    link.symlink_to(place)
    with whole_file(link, overwrite=True) as partial:
        partial.mkdir()
        (partial / "new").touch()
    assert link.is_symlink() and [path.name for path in place.iterdir()] == ["new"]


@pytest.mark.parametrize("name", ["runs.nc", "runs.zarr"])
def test_no_folder_of_others_is_replaced(tmp_path, name):
    """`--overwrite` deleted a folder, with all in it, that had the name of the file to write."""
    place = tmp_path / name
    place.mkdir()
    (place / "notes.txt").write_text("precious")
    refused = pytest.raises(FileExistsError, match=rf"{name} is a folder, not a file; choose")
    with refused, whole_file(place, overwrite=True):
        pytest.fail("nothing is computed")
    (place / "zarr.json").touch()  # a store, which no file replaces
    with refused, whole_file(place, overwrite=True) as partial:
        partial.touch()
    assert (place / "notes.txt").read_text() == "precious" and list(tmp_path.iterdir()) == [place]


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
    with pytest.raises(OSError) as raised, whole_file("x.csv") as partial:
        partial.write_text("half")
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
    """Every call that writes a file by name is given the `partial` path beside its place.

    Or an archive `in_memory`.

    Except caches, stores of sweeps, which are written in blocks under a lock, and what the page in
    the browser writes into a temporary folder of its own.
    """
    by_themselves = "jaxbeam.runtime.", "jaxbeam.simulation.sweeps.store"
    by_themselves += "jaxbeam.cli.page.studies", "jaxbeam.cli.page.questions"
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
                    if not names & {"partial", "file", "self", "in_memory"}:
                        wrong.append(f"{module}: {ast.unparse(node)[:80]}")
    assert wrong == []
