"""Build hook: a wheel with the C integrator, compiled by the compiler of the package ziglang.

For this machine where ziglang is installed, or for one of PLATFORMS named in JAXBEAM_PLATFORM, for
which pip or uv installs it: Zig compiles for all. Else the wheel is pure, and sweeps compile the C
when first of use, or do without.
"""

import hashlib
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

C_FOLDER = pathlib.Path(__file__).parent / "jaxbeam" / "runtime" / "native"
FLAGS = ("-shared", "-O2", "-g0", "-s", "-fno-math-errno", "-fno-sanitize=undefined")
X86 = ("x86-64-v2", "x86-64-v3")  # the latter with FMA and AVX2, of processors since 2013


class Platform(NamedTuple):
    """Tag of a wheel, target and suffix of its libraries, and their architectures."""

    tag: str
    target: str
    suffix: str
    architectures: tuple[str, ...]


# Those of jaxlib. Architectures are as `-march` has them, in ascending order of their names.
PLATFORMS = {
    "linux-x86_64": Platform("manylinux_2_17_x86_64", "x86_64-linux-gnu.2.17", ".so", X86),
    "linux-aarch64": Platform(
        "manylinux_2_17_aarch64", "aarch64-linux-gnu.2.17", ".so", ("armv8-a",)
    ),
    "darwin-arm64": Platform("macosx_11_0_arm64", "aarch64-macos.11.0", ".dylib", ("armv8-a",)),
    "win32-amd64": Platform("win_amd64", "x86_64-windows-gnu", ".dll", X86),
}


def source_hash(folder: pathlib.Path) -> str:
    """As `native_library.source_hash`, which the package needs at run time."""
    texts = (path.read_bytes() for path in sorted(folder.glob("*.[ch]")))
    return hashlib.sha256(b"".join(texts)).hexdigest()[:16]


def compile_for(found: Platform, folder: pathlib.Path) -> dict[str, str]:
    """Compile the libraries of a platform into a folder; their paths, and those in the wheel."""
    sources, paths = sorted(map(str, C_FOLDER.glob("*.c"))), {}
    for architecture in found.architectures:
        path = folder / f"{source_hash(C_FOLDER)}-{architecture}{found.suffix}"
        cpu = "baseline" if architecture == "armv8-a" else architecture.replace("-", "_")
        zig = [sys.executable, "-m", "ziglang", "cc", "-target", found.target, f"-mcpu={cpu}"]
        subprocess.run([*zig, *FLAGS, *sources, "-o", str(path)], check=True)
        paths[str(path)] = f"jaxbeam/runtime/native/compiled/{path.name}"
    return paths


class CustomBuildHook(BuildHookInterface):
    """Adds the libraries to a wheel."""

    def dependencies(self) -> list[str]:
        """The compiler, which is 100 MB, where one is asked for."""
        return ["ziglang>=0.15"] if os.environ.get("JAXBEAM_PLATFORM") else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, unless the sources are installed as they stand."""
        if version == "editable":
            return
        wanted = os.environ.get("JAXBEAM_PLATFORM")
        name = wanted or f"{sys.platform}-{platform.machine().lower()}"
        if name not in PLATFORMS and wanted:
            raise ValueError(f"JAXBEAM_PLATFORM is {name!r}, must be one of {', '.join(PLATFORMS)}")
        self.folder = tempfile.TemporaryDirectory()
        try:
            paths = compile_for(PLATFORMS[name], pathlib.Path(self.folder.name))
        except (KeyError, subprocess.CalledProcessError):
            if wanted:
                raise
            self.app.display_warning(
                "this wheel has no compiled C, which sweeps compile when first of use:"
                " install ziglang, or set JAXBEAM_PLATFORM, to compile it now"
            )
            return
        build_data["force_include"].update(paths)
        build_data |= {"pure_python": False, "tag": f"py3-none-{PLATFORMS[name].tag}"}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled."""
        if version != "editable":
            self.folder.cleanup()
