"""Drawings: the only floor that imports matplotlib, always as Figure objects and never through pyplot."""
