"""Command line: commands read arguments, call the library and print what it returns."""

from jaxbeam.cli.app import main as main
