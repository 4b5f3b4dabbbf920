"""Chapter5."""
