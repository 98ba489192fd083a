"""Compile this package's programs for accelerators that are not here, and count what they do."""

from scripts.compile_check.check import (
    CompileCheck,
    ProgramCheck,
    compile_check,
    differences,
    read_check,
)
from scripts.compile_check.programs import PROGRAMS
from scripts.compile_check.targets import MACHINES

__all__ = [
    "MACHINES",
    "PROGRAMS",
    "CompileCheck",
    "ProgramCheck",
    "compile_check",
    "differences",
    "read_check",
]
