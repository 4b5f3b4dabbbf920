"""Beams that are not uniform: sections, Ritz elements, statics, buckling, fields of the modes."""
