"""One file per format of a log; each turns a file into the same plain table."""

from tuning.readers.csv import read_csv
from tuning.readers.lvm import read_lvm
from tuning.readers.table import Table

__all__ = ["Table", "read_csv", "read_lvm"]
