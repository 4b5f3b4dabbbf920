"""Gains, estimators and filters for real controllers, as CSV, .mat, TDMS or a C header."""

from jaxbeam.files.export.designed import Gains, export_gains
from jaxbeam.files.export.files import WRITERS, read_gains, write_gains

__all__ = ["WRITERS", "Gains", "export_gains", "read_gains", "write_gains"]
