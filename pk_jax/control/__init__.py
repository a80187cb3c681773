"""Closed loops: a platform that follows a reference by what its sensors say."""
