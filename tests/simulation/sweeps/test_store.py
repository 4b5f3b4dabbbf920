"""Stores that are damaged, full or not writable: one sentence, and finished blocks are kept."""

import ast
import contextlib
import json
import os
import pickle
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr

import jaxbeam as jb
from jaxbeam.simulation.stored_record import read_record
from jaxbeam.simulation.sweeps.specification import SweepSpecification
from jaxbeam.simulation.sweeps.store import (
    ZarrStore,
    append_block,
    block_places,
    kept_blocks,
    read_block,
)
from tests.modules import module_files, parse
from tests.simulation.sweeps.test_sweep import CASE
from tuning import read_logs

OVER = {"loads.0.mass": np.linspace(0.1, 0.9, 200), "loads.0.speed": [1.5, 2.0, 4.0]}


def sweep(store: Path | None, **options) -> xarray.Dataset:
    return jb.sweep(CASE, OVER, store=store, progress=False, **options)


def stop_after(blocks: int, store: Path, **options) -> None:
    """Start a sweep and interrupt it after a number of blocks."""
    write = ZarrStore.write

    def stop(self, block, results):
        if block == blocks:
            raise KeyboardInterrupt
        write(self, block, results)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ZarrStore, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            sweep(store, **options)


def files_of(store: Path) -> dict[str, bytes]:
    """Every file of a store."""
    files = (path for path in sorted(store.rglob("*")) if path.is_file())
    return {str(path.relative_to(store)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """A complete store and its dataset."""
    path = tmp_path_factory.mktemp("complete") / "runs.zarr"
    return path, sweep(path)


@pytest.fixture
def copy(complete, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(complete[0], path)
    return path


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    """Store with two of three blocks."""
    path = tmp_path_factory.mktemp("unfinished") / "runs.zarr"
    stop_after(2, path)
    return path


def blocks_of(store: Path) -> Path:
    """Folder of the blocks of an unfinished store."""
    (folder,) = (path for path in (store / "blocks").iterdir() if path.is_dir())
    return folder


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def flip_bits(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) * 2 // 3] ^= 0x55
    path.write_bytes(content)


DAMAGES = {
    "truncated": truncate,
    "flipped bits": flip_bits,
    "empty": lambda p: p.write_bytes(b""),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("part", ["peak_deflection/c/0/0/0", "failed/c/0/0", "peak_time/zarr.json"])
def test_damaged_results_are_refused(copy, part, damage):
    DAMAGES[damage](copy / part)
    if (part, damage) == ("peak_time/zarr.json", "flipped bits"):
        (copy / part).write_text("{" + (copy / part).read_text())
    with pytest.raises(ValueError, match=r"runs\.zarr is damaged \(.*\): make the sweep anew"):
        sweep(copy, resume=True)
    assert (copy / "peak_deflection").is_dir()


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_blocks_are_computed_again(unfinished, complete, tmp_path, damage):
    path = tmp_path / "runs.zarr"
    shutil.copytree(unfinished, path)
    (file,) = blocks_of(path).glob("*.blocks")
    DAMAGES[damage](file)
    left = {"truncated": [1, 2], "flipped bits": [1, 2], "empty": [0, 1, 2], "missing": [0, 1, 2]}
    warns = damage == "flipped bits"  # the others are as if the writing had been interrupted
    sentence = "1 finished blocks are damaged and are computed again"
    with pytest.warns(UserWarning, match=sentence) if warns else contextlib.nullcontext():
        assert ZarrStore(path).missing(range(3)) == left[damage]
    with pytest.warns(UserWarning, match=sentence) if warns else contextlib.nullcontext():
        found = sweep(path, resume=True)
    xarray.testing.assert_identical(found, complete[1])


def test_files_of_blocks_are_regular_ones(unfinished, tmp_path):
    """A pipe would be waited for without an end."""
    path = tmp_path / "runs.zarr"
    shutil.copytree(unfinished, path)
    os.mkfifo(blocks_of(path) / f"{0:032x}.blocks")
    with pytest.raises(ValueError, match="is a named pipe, not a regular file"):
        ZarrStore(path)


def test_every_changed_byte_of_a_block_is_noticed(tmp_path):
    file, results = tmp_path / "a.blocks", {"x": np.arange(6.0).reshape(1, 3, 2), "y": np.ones(2)}
    for block in (7, 8):
        append_block(file, block, results)
    content = file.read_bytes()
    for place in range(len(content)):
        file.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        found = []
        for one in block_places(file):
            with contextlib.suppress(ValueError):
                found.append((one.block, read_block(one)))
        assert len(found) < 2
        for block, values in found:
            assert block in (7, 8)
            assert all(np.array_equal(values[name], results[name]) for name in results)
    for length in range(len(content)):
        file.write_bytes(content[:length])
        whole = [read_block(one) for one in block_places(file)]
        assert len(whole) == length // (len(content) // 2)


def test_large_sweeps_have_several_files_of_blocks(tmp_path, complete, monkeypatch):
    monkeypatch.setattr("jaxbeam.simulation.sweeps.store.MAX_FILE_BYTES", 1)
    path = tmp_path / "runs.zarr"
    stop_after(2, path)
    assert [len(list(block_places(file))) for file in blocks_of(path).glob("*.blocks")] == [1, 1]
    xarray.testing.assert_identical(sweep(path, resume=True), complete[1])


def test_blocks_of_objects_are_refused(tmp_path):
    file = tmp_path / "a.blocks"
    append_block(file, 0, {"x": np.array([None, 1], dtype=object)})
    (place,) = block_places(file)
    with pytest.raises(ValueError, match="OBJECT"):
        read_block(place)


def test_damaged_unfinished_stores_are_refused(unfinished, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(unfinished, path)
    flip_bits(blocks_of(path) / "steps" / "c" / "0")
    with pytest.raises(ValueError, match=r"is damaged"):
        sweep(path, resume=True)
    shutil.copytree(unfinished, path, dirs_exist_ok=True)
    text = (path / "zarr.json").read_text()
    (path / "zarr.json").write_text(text.replace('"jaxbeam_sweep": "', '"jaxbeam_sweep": "0'))
    with pytest.raises(ValueError, match="another case, other values or settings"):
        sweep(path, resume=True)
    truncate(path / "zarr.json")
    with pytest.raises(FileExistsError, match="is not a sweep of jaxbeam"):
        sweep(path, overwrite=True)
    assert list(blocks_of(path).glob("*.blocks"))


def test_full_disk_keeps_finished_blocks(unfinished, complete, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(unfinished, path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # bytes in a file
    try:
        with pytest.raises(OSError, match=r"cannot write .*: file too large; finished blocks are"):
            sweep(path, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert ZarrStore(path).missing(range(3)) == [2]
    xarray.testing.assert_identical(sweep(path, resume=True), complete[1])
    assert not list(path.rglob("*.partial"))


def test_finished_blocks_are_said_to_be_kept_where_there_are_some(unfinished, tmp_path):
    """It was said where none had finished, too."""
    stop_after(0, tmp_path / "runs.zarr")
    assert kept_blocks(tmp_path / "runs.zarr") == "no block has finished"
    assert kept_blocks(unfinished) == "finished blocks are kept"


def test_folder_that_is_not_writable_is_named_before_any_run(tmp_path, monkeypatch):
    monkeypatch.setattr(SweepSpecification, "uses_c", lambda _: pytest.fail("it runs"))
    with pytest.raises(OSError, match=r"cannot write runs\.zarr to the folder .*none: no such"):
        sweep(tmp_path / "none" / "runs.zarr")
    monkeypatch.setattr("tempfile.TemporaryFile", forbidden)
    with pytest.raises(PermissionError, match=r"cannot write runs\.zarr .*: permission denied"):
        sweep(tmp_path / "runs.zarr")
    assert not list(tmp_path.iterdir())


def forbidden(**_):
    raise PermissionError(13, "Permission denied")


# No code from files is run


class TracedObject:
    """Object whose unpickling creates a file."""

    def __init__(self, trace: Path):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def test_nothing_is_unpickled(copy, tmp_path):
    trace = tmp_path / "trace"
    objects = np.array([TracedObject(trace)] * 3, dtype=object)
    for name in ("run.csv", "run.mat", "run.npz", "run.nc", "run.h5", "run.tdms", "run.parquet"):
        with open(tmp_path / name, "wb") as file:
            np.savez(file, time=objects)
        with pytest.raises(ValueError):
            read_logs(tmp_path / name)
        with pytest.raises((ValueError, TypeError)):
            read_record(tmp_path / name)
    text = (copy / "peak_time" / "zarr.json").read_text()
    (copy / "peak_time" / "zarr.json").write_text(text.replace('"zstd"', '"numcodecs.pickle"'))
    with pytest.raises(ValueError, match="is damaged"):
        sweep(copy, resume=True)
    assert not trace.exists()


@pytest.mark.parametrize("place", ["root", "array", "named"])
def test_stores_with_codecs_that_run_code_are_refused(copy, tmp_path, place):
    """Zarr of format 2 has filters of numcodecs, of which `pickle` runs code of the store."""
    trace, array = tmp_path / "trace", copy / "peak_time"
    if place == "named":  # a codec that zarr finds by its name in any installed package
        text = (array / "zarr.json").read_text()
        (array / "zarr.json").write_text(text.replace('"zstd"', '"numcodecs.shuffle"'))
        with pytest.raises(ValueError, match=r"uses 'numcodecs\.shuffle', which jaxbeam does not"):
            sweep(copy, resume=True)
        return
    shutil.rmtree(array)
    array.mkdir()
    metadata = {
        "zarr_format": 2,
        "shape": [1],
        "chunks": [1],
        "dtype": "|O",
        "order": "C",
        "compressor": None,
        "fill_value": None,
        "filters": [{"id": "pickle", "protocol": 5}],
    }
    (array / ".zarray").write_text(json.dumps(metadata))
    (array / "0").write_bytes(pickle.dumps(np.array([TracedObject(trace)], dtype=object)))
    if place == "root":
        attributes = json.loads((copy / "zarr.json").read_text())["attributes"]
        (copy / "zarr.json").unlink()
        (copy / ".zgroup").write_text('{"zarr_format": 2}')
        (copy / ".zattrs").write_text(json.dumps(attributes))
        with pytest.raises(FileExistsError, match="is not a sweep of jaxbeam"):
            sweep(copy, resume=True)
    else:
        with pytest.raises(ValueError, match=r"is damaged \(jaxbeam writes no \.zarray"):
            sweep(copy, resume=True)
    assert not trace.exists()


def test_booleans_as_older_xarray_writes_them(copy, complete):
    """Versions before 2026 write int8 with the attribute `dtype = "bool"`."""
    group = zarr.open_group(copy)
    before = group["failed"]
    assert isinstance(before, zarr.Array)
    values, names = np.asarray(before[...], np.int8), before.metadata.dimension_names
    group.create_array(
        "failed",
        data=values,
        attributes={**before.attrs, "dtype": "bool"},
        dimension_names=names,
        overwrite=True,
        config={"write_empty_chunks": True},
    )
    assert '"int8"' in (copy / "failed" / "zarr.json").read_text()
    xarray.testing.assert_identical(sweep(copy, resume=True).failed, complete[1].failed)


# Libraries go through one file, which verifies the HMAC of what it reads; nothing is unpickled.
VETTED = "jaxbeam.runtime.native_library"
RUN = {"eval", "exec", "compile", "__import__"}
UNPICKLE = {"pickle", "cloudpickle", "marshal", "shelve", "dill", "joblib", "runpy"}
LOAD = {"CDLL", "PyDLL", "WinDLL", "OleDLL", "LibraryLoader", "LoadLibrary", "load_library"}
LOAD |= {"cdll", "pydll", "windll", "oledll", "dlopen", "deserialize_and_load", "read_pickle"}


def code_from_files(tree: ast.Module) -> list[str]:
    """What a module does that may run code from a file."""
    found = []
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name)) if name in RUN:
                found.append(f"calls {name}")
            case ast.Attribute(value=ast.Name(id="builtins"), attr=name) if name in RUN:
                found.append(f"names {name}")
            case ast.Attribute(attr=name) if name in LOAD:
                found.append(f"names {name}")
            case ast.keyword(arg="allow_pickle", value=value):
                if getattr(value, "value", True) is not False:
                    found.append("allows pickles")
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                named = {alias.name for alias in names} | {getattr(node, "module", None)}
                found += [f"imports {name}" for name in sorted(named & (UNPICKLE | LOAD), key=str)]
    return found


def test_no_module_but_one_runs_code_from_files():
    modules = module_files().items()
    found = {name: faults for name, path in modules if (faults := code_from_files(parse(path)))}
    assert {name: set(faults) for name, faults in found.items()} == {VETTED: {"names CDLL"}}


@pytest.mark.parametrize(
    "source",
    [
        "eval(text)",
        "import builtins; builtins.exec(text)",
        "from pickle import loads",
        "from ctypes import CDLL",
        "ctypes.cdll.LoadLibrary(path)",
        "numpy.ctypeslib.load_library(name, folder)",
        "numpy.load(path, allow_pickle=True)",
        "pandas.read_pickle(path)",
        "import runpy",
    ],
)
def test_code_from_files_is_found(source):
    assert code_from_files(ast.parse(source))
