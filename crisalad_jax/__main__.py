"""The program `crisalad`, also `python -m crisalad_jax`: the command line as a process."""

import sys

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import keep_on_without_reader
from crisalad_jax.utils.signals import end_at_signals


def main() -> None:
    """Run the command that the arguments name, and end the process with its exit code."""
    end_at_signals()
    keep_on_without_reader()
    # Imported after signals are handled, because it takes a while.
    from crisalad_jax.cli import main as run_command

    code = run_command(keep_programs=True)
    try:
        sys.stdout.flush()
    except InputError as error:  # a full disk, which the last lines met
        if not code:
            print(f"crisalad: {error}", file=sys.stderr)
            code = 2
    sys.exit(code)


if __name__ == "__main__":
    main()
