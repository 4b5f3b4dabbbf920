"""Reproduction of a thesis: its published numbers beside those that jaxbeam computes.

"Active structural control of single and multi-span beam structures subjected to transient loads",
Liverpool John Moores University. A folder holds the experiments of a chapter, and in `published.py`
every number printed there that a computation can be compared with: the digits as printed, where,
the unit, whether measured or computed, and the tolerance, which follows from the kind of number and
was chosen before any experiment was run.

Not listed, because no computation here bears on them: computing times of the author's machine
(Figs 7.4, 7.8), measured velocities (Fig. 5.22), the 0.1 mm by which a lever of the supports sank
(Figs 2.11 to 2.13), and curves without a number (Figs 2.7, 2.10, 2.21, 2.22, 2.31 to 2.36, 5.1 to
5.4, 5.14 to 5.16, 5.29). The measured curves are not available.
"""
