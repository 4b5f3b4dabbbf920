"""`python -m jaxbeam`: the command line."""

from jaxbeam.cli import main

main()
