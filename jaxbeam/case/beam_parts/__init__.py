"""Parts of a beam: segments of stepped and tapered beams, hinges."""
