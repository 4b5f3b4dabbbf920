"""One law from the sensors alone for all rigs: its plants, its numbers, and what it loses."""
