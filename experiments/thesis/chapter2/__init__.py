"""Chapter2."""
