"""One verdict a row: every batched answer of the library carries a `Status`."""

from __future__ import annotations

import enum


class Status(enum.IntEnum):
    """What became of one row. Anything but `OK` comes with NaN in the answer itself."""

    OK = 0  # solved, and checked afresh
    OTHER_MODE = 1  # solved, but on the other side of a type II singularity than the start
    INCONSISTENT = 2  # redundant equations disagree by more than the stated threshold
    UNREACHABLE = 3  # no real solution exists for this row
    SINGULAR = 4  # the velocity relation has lost rank here
    STALLED = 5  # the iteration stopped moving away from a solution
    STEP_LIMIT = 6  # the iteration was still moving when its steps ran out
    NONFINITE = 7  # NaN or infinity appeared on the way
    INCOMPLETE = 8  # not reached, or some solutions may be missing
    BAD_INPUT = 9  # NaN, infinity, a negative length came in: there is no question to answer
