"""Comparison of two versions of jaxbeam: cases of all kinds, number by number.

    python -m experiments.validation.same_results write NEW.npz
    python -m experiments.validation.same_results write OLD.npz --checkout FOLDER
    python -m experiments.validation.same_results compare OLD.npz NEW.npz [--tolerance 1e-12]

`write` runs every case and stores all numbers; with `--checkout` by jaxbeam and tuning of another
checkout, such as a git worktree. `compare` prints the largest relative difference of each case, in
which an array is measured by its largest number, and exits with 1 if one exceeds the tolerance or
an array is missing. Cases use only the public interface: names in `jaxbeam.__all__` and
`tuning.__all__`, case files, and commands; where a name is missing, the one before it.

Programs are compiled anew, in an empty cache folder; wall times are left out. Differences between
machines are larger: write both files on one.
"""
