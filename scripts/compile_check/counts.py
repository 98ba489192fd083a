"""Count the work of a compiled program on one device: products, memory traffic, messages.

A loop's body counts once per iteration. For a conditional, only the branch with the least traffic
counts: in this package the other one is a fallback for scores out of range.
"""

import collections
import functools
import math
import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from scripts.compile_check.hlo import Array, Computation, Module, Operation

COLLECTIVES = (
    *("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute"),
    *("collective-broadcast", "ragged-all-to-all"),
)
_FREE = {
    *("parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "while"),
    *("partition-id", "replica-id", "opt-barrier", "add-dependency", "conditional", "call"),
}
_NO_WORK = ("AllocateBuffer", "ConcatBitcast")
"""TPU custom calls that only name memory."""
KERNEL = "tpu_custom_call"
"""Target of a Pallas kernel for a TPU."""
_CUDNN = "__cudnn$fmha"
"""Prefix of the targets of cuDNN's fused attention."""


class Work(NamedTuple):
    """The work of one operation, and how often it runs."""

    name: str
    kind: str
    times: int
    flops: Mapping[str, int]
    """Floating-point operations of products per run, by operand type, with ":highest" or ":high"
    appended if that precision is requested."""
    bytes: int
    """Bytes of HBM read and written per run."""
    sent: int
    """Bytes that a device sends to others per run, if messages go around a ring."""
    cycles: int | None
    """The compiler's estimate of clock cycles per run; None without an estimate."""
    target: str
    """See `Operation.target`."""
    source: str
    """See `Operation.source`."""


class Counts(NamedTuple):
    """The work of a compiled program on one device."""

    work: list[Work]
    collectives: dict[str, int]
    """Number of collectives in the program's text, by kind."""
    bfloat16_sums: int
    """Number of collectives in the text that sum bfloat16 numbers. Two kinds on a TPU don't count,
    because they round no sum: one of float32 numbers whose result is rounded on arrival; and a
    gather written as a sum, in which each number comes from one device and the others add zeros."""
    fused_attention: int
    """Number of calls in the text of cuDNN's attention, and of Pallas kernels on a TPU."""
    host_callbacks: int
    """Number of operations in the text that wait for the host."""
    unknown_loops: list[str]
    """Loops whose number of iterations is unknown at compile time; they count once."""

    @property
    def flops(self) -> int:
        """Floating-point operations of all products."""
        return sum(each.times * sum(each.flops.values()) for each in self.work)

    @property
    def bytes(self) -> int:
        """Bytes of HBM read and written at the boundaries of fusions."""
        return sum(each.times * each.bytes for each in self.work)

    @property
    def sent(self) -> int:
        """Bytes that a device sends to others."""
        return sum(each.times * each.sent for each in self.work)


def count(
    module: Module, devices: int = 1, kernel_cycles: Mapping[str, int] = MappingProxyType({})
) -> Counts:
    """Count the work of a program on one device.

    Args:
        module: the program.
        devices: number of devices, for collectives that don't name their group.
        kernel_cycles: cycles of the kernels by name; see `kernels.kernel_cycles`.

    Returns:
        The counts.
    """
    counter = _Counter(module, devices, kernel_cycles)
    work = list(counter.walk(module.entry, 1))
    operations = module.operations()
    collectives = [each for each in operations if _collective(each) is not None]
    return Counts(
        work,
        dict(collections.Counter(str(_collective(each)) for each in collectives)),
        sum(_bfloat16_sums(each, module) for each in module.computations.values()),
        sum(each.target == KERNEL or each.target.startswith(_CUDNN) for each in operations),
        sum(map(_waits_for_host, operations)),
        counter.unknown_loops,
    )


def _collective(operation: Operation) -> str | None:
    kind = operation.kind.removesuffix("-start")
    return kind if kind in COLLECTIVES else None


def _bfloat16_sums(computation: Computation, module: Module) -> int:
    operations = computation.operations
    sums = [
        each
        for each in operations.values()
        if _collective(each) in ("all-reduce", "reduce-scatter")
    ]
    return sum(
        any(
            array.dtype == "bf16" and not _is_one_devices(operations[name], module)
            for name in each.operands
            for array in operations[name].arrays
        )
        for each in sums
    )


def _is_one_devices(operation: Operation, module: Module) -> bool:
    """Return whether a result is one device's part in an array of zeros for all devices."""
    if operation.kind == "fusion":
        (body,) = [name for key, name in operation.called if key == "calls"]
        operation = module.computations[body].root
    return operation.kind == "dynamic-update-slice"


def _waits_for_host(operation: Operation) -> bool:
    return operation.kind in ("infeed", "outfeed") or "callback" in operation.target


class _Counter:
    def __init__(self, module: Module, devices: int, kernel_cycles: Mapping[str, int]) -> None:
        self._computations = module.computations
        self._devices = devices
        self._kernel_cycles = kernel_cycles
        self.unknown_loops: list[str] = []

    def walk(self, name: str, times: int) -> Iterator[Work]:
        """Yield the work of a computation that runs `times` times."""
        computation = self._computations[name]
        for operation in computation.operations.values():
            called = dict(operation.called)
            if operation.kind == "while":
                turns = self._turns(operation, called["condition"])
                yield from self.walk(called["body"], times * turns)
            elif operation.kind == "conditional":
                branches = [list(self.walk(branch, times)) for _, branch in operation.called]
                yield from min(branches, key=_traffic)
            elif operation.kind in ("call", "async-start"):
                for key, each in operation.called:
                    if key in ("to_apply", "calls"):
                        yield from self.walk(each, times)
            elif not _is_free(operation):
                yield self._work(operation, computation, times)

    def _turns(self, loop: Operation, condition: str) -> int:
        known = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', loop.attributes)
        if known is not None:
            return int(known[1])
        operations = self._computations[condition].operations
        root = self._computations[condition].root
        limits = [operations[x].inside for x in root.operands if operations[x].kind == "constant"]
        # JAX counts from 0 up to a constant, exclusive.
        if root.kind == "compare" and "direction=LT" in root.attributes and len(limits) == 1:
            return int(limits[0])
        self.unknown_loops.append(loop.name)
        return 1

    def _work(self, operation: Operation, computation: Computation, times: int) -> Work:
        cycles = re.search(r'"estimated_cycles":"(\d+)"', operation.attributes)
        sent = 0
        if _collective(operation) is not None:
            group = _group_size(operation) or self._devices
            sent = _sent(operation, computation, group)
        return Work(
            operation.name,
            operation.kind,
            times,
            self._flops(operation, computation),
            self._bytes(operation, computation),
            sent,
            self._kernel_cycles.get(operation.name) if cycles is None else int(cycles[1]),
            operation.target,
            operation.source,
        )

    def _flops(self, operation: Operation, computation: Computation) -> Mapping[str, int]:
        if operation.kind == "fusion":
            total: collections.Counter[str] = collections.Counter()
            for _, name in operation.called:
                inner = self._computations[name]
                for each in inner.operations.values():
                    total.update(self._flops(each, inner))
            return total
        counted = flops_of(operation, computation)
        return {} if not counted else {_product_type(operation, computation): counted}

    def _bytes(self, operation: Operation, computation: Computation) -> int:
        operands = [computation.operations[x].arrays for x in dict.fromkeys(operation.operands)]
        if operation.kind == "fusion":
            return self._fusion_bytes(dict(operation.called)["calls"])
        if operation.kind in ("copy-start", "slice-start"):
            return _moved(operation)
        if operation.kind in ("dynamic-slice", "slice", "gather"):
            read = operation.arrays[0].bytes if not operands[0][0].on_chip else 0
            return read + operation.arrays[0].hbm_bytes
        if operation.kind == "dynamic-update-slice":
            update = operands[1][0]
            return update.hbm_bytes + (0 if operation.arrays[0].on_chip else update.bytes)
        read = sum(array.hbm_bytes for arrays in operands for array in arrays)
        if (
            _collective(operation) is not None
            and operation.kind.endswith("-start")
            and (operation.kind != "all-reduce-start")
        ):
            read = 0  # the tuple of its result repeats what it reads
        return read + sum(array.hbm_bytes for array in _written(operation))

    def _fusion_bytes(self, name: str) -> int:
        written, in_place = self._written(name)
        parameters = self._computations[name].parameters
        return written + sum(
            self._read(name, number) for number in parameters if number not in in_place
        )

    def _read(self, name: str, number: int) -> int:
        """Count the bytes of HBM that a fused computation reads of a parameter.

        If only slices of it are used, only these are read.
        """
        computation = self._computations[name]
        parameter = computation.parameters[number]
        whole = sum(array.hbm_bytes for array in parameter.arrays)
        if not whole:
            return 0
        sliced = 0
        pending = [parameter.name]
        while pending:
            current = pending.pop()
            if current == computation.root.name:
                return whole
            for user in computation.users(current):
                if user.kind == "bitcast":
                    pending.append(user.name)
                elif user.kind in ("dynamic-slice", "slice", "gather") and (
                    user.operands[0] == current
                ):
                    sliced += user.arrays[0].bytes
                elif user.kind == "fusion":
                    inner = dict(user.called)["calls"]
                    for position, operand in enumerate(user.operands):
                        if operand == current:
                            sliced += self._read(inner, position)
                else:
                    return whole
        return min(sliced, whole)

    def _written(self, name: str) -> tuple[int, set[int]]:
        """Count the bytes of HBM that a fused computation writes.

        Returns:
            The bytes, and the parameters that are updated in place and so not read.
        """
        computation = self._computations[name]
        written, in_place = 0, set()
        for result in computation.results():
            each = _behind(result, computation, ("bitcast", "copy", "convert"))
            if each.kind == "dynamic-update-slice":
                written += computation.operations[each.operands[1]].arrays[0].bytes
                base = computation.operations[each.operands[0]]
                base = _behind(base, computation, ("bitcast", "copy", "convert"))
                if base.kind == "parameter":
                    in_place.add(int(base.inside))
            elif each.kind == "fusion":
                inner = dict(each.called)["calls"]
                more, inner_in_place = self._written(inner)
                written += more
                for number in inner_in_place:
                    base = computation.operations[each.operands[number]]
                    if base.kind == "parameter":
                        in_place.add(int(base.inside))
            else:
                written += sum(array.hbm_bytes for array in result.arrays)
        return written, in_place


def _behind(operation: Operation, computation: Computation, kinds: tuple[str, ...]) -> Operation:
    """Follow the first operands back through operations that preserve their input."""
    while operation.kind in kinds and operation.operands[0] in computation.operations:
        operation = computation.operations[operation.operands[0]]
    return operation


def _traffic(work: list[Work]) -> tuple[int, int]:
    return sum(each.times * each.bytes for each in work), len(work)


def _is_free(operation: Operation) -> bool:
    return (
        operation.kind in _FREE
        or operation.kind.endswith(("-done", "-update"))
        or operation.target in _NO_WORK
    )


def _written(operation: Operation) -> tuple[Array, ...]:
    """Return the arrays of a result, without the workspace of a library call."""
    arrays = operation.arrays
    if operation.kind == "custom-call" and len(arrays) > 1 and arrays[-1].dtype in ("s8", "u8"):
        return arrays[:-1]
    return arrays


def _moved(operation: Operation) -> int:
    """Count the bytes of an asynchronous copy or slice between memories."""
    first, second, *_ = operation.arrays
    # A copy lists its destination first, a slice its source.
    source, destination = (second, first) if operation.kind == "copy-start" else (first, second)
    size = destination.bytes
    return (0 if source.on_chip else size) + (0 if destination.on_chip else size)


def _group_size(operation: Operation) -> int | None:
    iota = re.search(r"replica_groups=\[\d+,(\d+)\]<=", operation.attributes)
    if iota is not None:
        return int(iota[1])
    meshed = re.search(r"replica_groups=mesh\[([^\]]*)\] \{([^}]*)\}", operation.attributes)
    if meshed is not None:
        sizes = dict(re.findall(r"'([^']+)'=(\d+)", meshed[1]))
        return math.prod(int(sizes[axis]) for axis in re.findall(r"'([^']+)'", meshed[2]))
    listed = re.search(r"replica_groups=\{\{([\d,]*)\}", operation.attributes)
    return None if listed is None else len(listed[1].split(","))


def _sent(operation: Operation, computation: Computation, group: int) -> int:
    operands = (computation.operations[x].arrays for x in operation.operands)
    given = sum(array.bytes for arrays in operands for array in arrays)
    share = (group - 1) / group
    kind = _collective(operation)
    return round(
        {
            "all-reduce": 2 * share * given,
            "all-gather": (group - 1) * given,
            "reduce-scatter": share * given,
            "all-to-all": share * given,
        }.get(str(kind), given)
    )


def flops_of(operation: Operation, computation: Computation) -> int:
    """Count the floating-point operations of a product: two per multiply-add.

    Args:
        operation: a dot, a convolution, or a library call for a product or attention; anything else
            counts 0.
        computation: the computation that contains it.

    Returns:
        The number of operations. Taps of a convolution that fall on padding don't count.
    """
    target = operation.target

    def operand(position: int) -> Array:
        return computation.operations[operation.operands[position]].arrays[0]

    if operation.kind == "dot":
        contracted = _numbers(r"lhs_contracting_dims=\{([\d,]*)\}", operation.attributes)
        length = math.prod(operand(0).dims[axis] for axis in contracted)
        return 2 * math.prod(operation.arrays[0].dims) * length
    if operation.kind == "convolution":
        return _convolution(operation, operand(0), operand(1), operation.arrays[0])
    if '"gemm_backend_config":' in operation.attributes:
        contracted = _numbers(r'"lhs_contracting_dimensions":\[([^\]]*)\]', operation.attributes)
        length = math.prod(operand(0).dims[axis] for axis in contracted)
        return 2 * math.prod(operation.arrays[0].dims) * length
    if target.startswith(_CUDNN):
        # Arrays are (batch, token, head, dim). The backward pass recomputes the scores.
        batch, queries, heads, numbers = operand(0).dims
        products = 5 if target.endswith("Backward") else 2
        return 2 * products * batch * heads * queries * operand(1).dims[1] * numbers
    if target.startswith("__cudnn$conv"):
        result = operation.arrays[0]
        arrays = {
            "__cudnn$convBackwardInput": lambda: (result, operand(1), operand(0)),
            "__cudnn$convBackwardFilter": lambda: (operand(0), result, operand(1)),
        }.get(target, lambda: (operand(0), operand(1), result))()
        return _convolution(operation, *arrays)
    if target == KERNEL:
        estimate = re.search(r'"flops":"?(\d+)', operation.attributes)
        return 0 if estimate is None else int(estimate[1])
    return 0


def _numbers(pattern: str, text: str) -> list[int]:
    found = re.search(pattern, text)
    return [] if found is None else [int(n) for n in re.findall(r"\d+", found[1])]


def _product_type(operation: Operation, computation: Computation) -> str:
    dtype = computation.operations[operation.operands[0]].arrays[0].dtype
    precisions = re.findall(
        r'operand_precision"?[=:][\{\[]"?(\w+)', operation.attributes, re.IGNORECASE
    )
    precision = precisions[0].lower() if precisions else "default"
    return dtype if precision == "default" else f"{dtype}:{precision}"


def _convolution(operation: Operation, image: Array, kernel: Array, result: Array) -> int:
    labels = re.search(r"dim_labels=(\w+)_(\w+)->(\w+)", operation.attributes)
    assert labels is not None
    window = re.search(r"window=\{([^}]*)\}", operation.attributes)
    spatial = len(labels[1]) - 2
    fields = dict(part.split("=") for part in (window[1].split() if window else ()))

    def along(field: str, default: str) -> list[str]:
        return fields.get(field, "x".join([default] * spatial)).split("x") if spatial else []

    macs = result.dims[labels[3].index("b")] * result.dims[labels[3].index("f")]
    macs *= kernel.dims[labels[2].index("i")]
    for axis, size, stride, pad, dilated, spread in zip(
        range(spatial),
        along("size", "1"),
        along("stride", "1"),
        along("pad", "0_0"),
        along("lhs_dilate", "1"),
        along("rhs_dilate", "1"),
        strict=True,
    ):
        macs *= _taps(
            image.dims[labels[1].index(str(axis))],
            result.dims[labels[3].index(str(axis))],
            int(size),
            int(stride),
            int(pad.partition("_")[0]),
            int(dilated),
            int(spread),
        )
    return 2 * macs


@functools.cache
def _taps(
    inputs: int, outputs: int, size: int, stride: int, pad: int, dilated: int, spread: int
) -> int:
    """Count the pairs of an output and a window tap that fall on an input, along one axis."""
    starts = np.arange(outputs, dtype=np.int64) * stride - pad
    total = 0
    for tap in range(size):
        at = starts + tap * spread
        total += int(((at % dilated == 0) & (at >= 0) & (at < inputs * dilated)).sum())
    return total
