"""Poses, their tangents, and elementary functions whose derivatives stay finite."""
