"""`python -m crisalad_jax` is the command line."""

import sys

from crisalad_jax.cli import main

sys.exit(main())
