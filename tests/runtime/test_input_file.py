"""Files that are read: which are refused before they are opened, and what is said of them."""

import ast
import io
import os
import socket
import zipfile

import numpy as np
import pytest

import jaxbeam as jb
import tuning
from jaxbeam.files.case_file import load_case_with
from jaxbeam.files.export import read_gains
from jaxbeam.files.profile_file import profile_from_file
from jaxbeam.runtime import input_file
from jaxbeam.runtime.input_file import describe_content, read_input
from tests.modules import module_files, parse
from tuning.checkpoint import read_arrays

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
    "jaxbeam.library.",
    "jaxbeam.benchmark.",  # of the package
    "jaxbeam.c_code.translation",
    "jaxbeam.analysis.assessment.assessment",
    "jaxbeam.app.server",  # of the package
    "jaxbeam.app.take_away",  # what it wrote into a temporary folder
    "jaxbeam.case.loads.vehicles.vehicle",
    "jaxbeam.cli.",
    "jaxbeam.files.export.files",
    "jaxbeam.files.interactive",  # of the package
    "jaxbeam.files.netcdf",
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
