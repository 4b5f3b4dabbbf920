"""Chapter7."""
