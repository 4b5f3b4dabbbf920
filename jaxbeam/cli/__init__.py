"""Command line: commands read arguments, call the library and print what it returns."""

from jaxbeam.runtime.packages import find_siblings

find_siblings()  # the working folder may have other modules named `tuning` or `experiments`

from jaxbeam.cli.app import main as main  # noqa: E402
