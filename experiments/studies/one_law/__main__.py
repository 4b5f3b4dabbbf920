"""`python -m experiments.studies.one_law`: the law on all plants (see `plants`)."""

import sys

from experiments.studies.one_law.plants import main

if __name__ == "__main__":
    main(sys.argv[1:])
