"""What `crisalad compare` compares: the paper's Table 1, and BoQ."""

from collections.abc import Mapping
from typing import NamedTuple


class ComparedMethod(NamedTuple):
    """A line of the table."""

    title: str
    """As its authors write it."""
    recipe: str
    """Of `RECIPES`; methods of one recipe share its runs."""
    rerank: str | None = None
    """What ranks the first retrievals anew."""
    learns: bool = True
    """Whether anything is trained; what does not learn is described as it starts."""


METHODS: Mapping[str, ComparedMethod] = {
    "netvlad": ComparedMethod("NetVLAD", "netvlad"),
    "gem": ComparedMethod("GeM", "gem"),
    "conv-ap": ComparedMethod("Conv-AP", "conv-ap"),
    "patch-netvlad": ComparedMethod("Patch-NetVLAD", "netvlad", rerank="patch-netvlad"),
    "transvpr": ComparedMethod("TransVPR", "transvpr", rerank="transvpr"),
    "cosplace": ComparedMethod("CosPlace", "cosplace"),
    "mixvpr": ComparedMethod("MixVPR", "mixvpr"),
    "eigenplaces": ComparedMethod("EigenPlaces", "eigenplaces"),
    "anyloc": ComparedMethod("AnyLoc", "anyloc", learns=False),
    "cricavpr": ComparedMethod("CricaVPR", "cricavpr"),
    "salad": ComparedMethod("DINO-SALAD", "salad"),
    "crisalad": ComparedMethod("CriSALAD", "crisalad"),
    "boq": ComparedMethod("BoQ", "boq"),
}
"""In the order of the paper's Table 1. A new method is a line here, and a recipe."""
