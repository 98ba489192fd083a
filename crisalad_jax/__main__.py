"""Run the command line: the program `crisalad`, or `python -m crisalad_jax`."""

import io
import os
import sys
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.signals import end_at_signals


def main() -> None:
    """Run the command that `sys.argv` names, and exit the process with the command's exit code."""
    end_at_signals()
    keep_on_without_reader()
    # Imported after signals are handled, because it takes a while.
    from crisalad_jax.cli import main as run_command

    code = run_command(keep_programs=True)
    try:
        sys.stdout.flush()
    except InputError as error:  # a full disk, met by the last lines
        if not code:
            print(f"crisalad: {error}", file=sys.stderr)
            code = 2
    sys.exit(code)


def keep_on_without_reader() -> None:
    """Let the program continue when the reader of its output has exited, as `| head` does.

    Later output is dropped. A full disk raises `InputError` once, at the first failing write to
    standard output; on standard error it is ignored. Characters the encoding lacks are escaped.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # it was closed, as by `>&-`
            stream = open(os.devnull, "w")  # noqa: SIM115
        else:
            stream = io.TextIOWrapper(
                io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False)),
                encoding=stream.encoding,
                errors="backslashreplace",
                line_buffering=stream.line_buffering or stream.write_through,  # python -u
            )
        setattr(sys, name, stream)


class _Output(io.FileIO):
    """A file that drops what is written after its reader is gone, or after an error.

    Python flushes once more at exit, which would otherwise print a traceback.
    """

    _failed = False

    def write(self, data: Any) -> int:
        if not self._failed:
            try:
                return super().write(data)
            except OSError as error:
                self._failed = True
                if not isinstance(error, BrokenPipeError) and self.fileno() != 2:
                    raise InputError(f"standard output: {error.strerror}") from error
        return memoryview(data).nbytes


if __name__ == "__main__":
    main()
