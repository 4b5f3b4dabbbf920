"""Cases and results in words for people: numbers with units, prefixes of units, addresses."""
