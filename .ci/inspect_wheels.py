"""Look into the C libraries of wheels, also of platforms that do not run here.

    python .ci/inspect_wheels.py WHEELS...

Each must be of the machine that the wheel names, have the functions that jaxbeam calls and no
others, and need nothing but the C library and the kernel of its system.
"""

import re
import sys
import zipfile

import lief

FUNCTIONS = {"integrate_peaks", "runs_x86_64_v3"}
OF_LINKER = {"dso_handle", "mh_dylib_header", "mh_execute_header"}  # of macOS
SYSTEM = r"libc\.so\.6|/usr/lib/libSystem\.B\.dylib|KERNEL32\.dll|api-ms-win-crt-.*\.dll"
MACHINES = {"x86_64": "X86_64", "amd64": "AMD64", "aarch64": "AARCH64", "arm64": "ARM64"}

for wheel in sys.argv[1:]:
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if "/native/compiled/" in name]
        if not names and wheel.endswith("-any.whl"):
            continue
        assert names, f"{wheel} has no library"
        for name in names:
            library = lief.parse(archive.read(name))
            header = library.header
            machine = getattr(header, "machine_type", None) or getattr(
                header, "machine", getattr(header, "cpu_type", None)
            )
            expected = next(word for end, word in MACHINES.items() if wheel.endswith(f"{end}.whl"))
            assert machine.name == expected, f"{name} is for {machine.name}, not {expected}"
            exported = {function.name.lstrip("_") for function in library.exported_functions}
            assert exported - OF_LINKER == FUNCTIONS, f"{name} exports {sorted(exported)}"
            needed = {str(getattr(part, "name", part)) for part in library.libraries}
            needed -= {part for part in needed if part.endswith(name.rpartition("/")[2])}  # its own
            foreign = {part for part in needed if not re.fullmatch(SYSTEM, part)}
            assert not foreign, f"{name} needs {sorted(foreign)}"
            if isinstance(library, lief.MachO.Binary):  # without one macOS loads nothing on arm64
                assert library.has_code_signature, f"{name} is not signed"
            print(f"{wheel.rpartition('/')[2]}: {name.rpartition('/')[2]}, needs {sorted(needed)}")
