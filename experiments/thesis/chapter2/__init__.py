"""Chapter 2: modes, moving force and moving mass, shaker, patches, identification."""
