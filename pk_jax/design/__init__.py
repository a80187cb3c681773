"""Design variables, the composite index, gradient ascent; sensors placed, geometries identified."""
