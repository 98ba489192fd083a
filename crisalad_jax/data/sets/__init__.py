"""Public data sets by name: a table of them, their download, and the check of a folder."""

from crisalad_jax.data.sets.check import CheckedFolder as CheckedFolder
from crisalad_jax.data.sets.check import CheckedPart as CheckedPart
from crisalad_jax.data.sets.check import check_set as check_set
from crisalad_jax.data.sets.fetch import fetch_set as fetch_set
from crisalad_jax.data.sets.table import SETS as SETS
from crisalad_jax.data.sets.table import PublishedSet as PublishedSet
from crisalad_jax.data.sets.table import find_set as find_set
