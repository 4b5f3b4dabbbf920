"""Controllers as programs in C99, for real-time systems."""

from jaxbeam.c_code.program import CProgram, export_c, write_c

__all__ = ["CProgram", "export_c", "write_c"]
