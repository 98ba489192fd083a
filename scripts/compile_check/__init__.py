"""Compile this package's programs for absent accelerators, and count their operations."""

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
