"""Published designs, each with its source."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from pk_jax.mechanisms.base import Mechanism
from pk_jax.mechanisms.five_bar import FiveBar
from pk_jax.mechanisms.two_rpr import TwoRPR

_NAM = "Nam, Lee and Park 2006, Trans. KSME A 30(11)"


class Entry(NamedTuple):
    """A design by name. `make` builds it, so that reading the catalogue creates no array."""

    make: Callable[[], Mechanism]
    source: str


CATALOGUE: dict[str, Entry] = {
    "nam-2-rpr": Entry(
        lambda: TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0),
        f"{_NAM}, Table 1, chosen for all three indices; lengths over R",
    ),
    "nam-2-rrr": Entry(
        lambda: FiveBar(half_base=1.0, proximal=1.0, distal=2.15),
        f"{_NAM}, Table 2, chosen for all three indices; lengths over R",
    ),
    "nam-2-rrr-isotropic": Entry(
        lambda: FiveBar(half_base=1.0, proximal=1.39, distal=2.69, reach=(2.08, 4.08)),
        f"{_NAM}, Table 2, weights (1, 0, 0); lengths over R",
    ),
}


def catalogued(name: str) -> Mechanism:
    """The mechanism of a catalogue entry."""
    if name not in CATALOGUE:
        raise ValueError(f"no catalogue entry {name!r}; there are {', '.join(CATALOGUE)}")
    return CATALOGUE[name].make()
