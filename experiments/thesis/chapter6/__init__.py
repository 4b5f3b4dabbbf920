"""Chapter 6: displacement feedback of one and two spans with patches."""
