"""Haunched bridge: natural frequencies, and the envelope of the moment under a train."""

import dataclasses
from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_envelope


def main(out: Path = Path("out/examples")) -> float:
    """Largest hogging moment over the pier (N m), printed; the envelope drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    frequencies = jb.modes(case).frequencies[:4]
    print("natural frequencies (Hz):", *(f"{f:.2f}" for f in frequencies))
    coarse = jb.replace(case, {"run.sample_rate": 50.0})
    record = jb.simulate(dataclasses.replace(coarse, beam=dataclasses.replace(case.beam, modes=8)))
    hogging = float(record.bending_moment(30.0).min())
    print(f"moment over the pier {hogging / 1e6:.2f} MN m")
    out.mkdir(parents=True, exist_ok=True)
    plot_envelope(record, "moment").savefig(out / "haunched_bridge.png", dpi=150)
    return hogging


if __name__ == "__main__":
    main()
