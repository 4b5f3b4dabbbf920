"""Command line: commands read arguments, call the library and print what it returns."""

from jaxbeam.runtime.own_packages import find_beside

find_beside()  # commands import `tuning` and `experiments`, of which the folder may have others

from jaxbeam.cli.app import main as main  # noqa: E402
