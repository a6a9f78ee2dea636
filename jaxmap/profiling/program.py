"""The stage, the arithmetic and the memory traffic of each operation of a compiled program, read from its text.

XLA keeps the `jax.named_scope` that an operation comes from as its `op_name`, through fusion and scheduling; traces
name operations but not their scopes. The text has both.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxmap.native.build import TARGET

STAGES = (
    *("rectify", "match", "project", "transform", "relief", "mlesac", "plane_labels", "network", "pixel_labels"),
    *("view_window", "fuse", "carve", "count_points", "frame_evidence", "add_evidence", "fuse_members"),
)
"""The named scopes of the step, in its order."""

OTHER = "other"
"""Operations outside all of them."""

_CONTAINERS = {"while", "call", "conditional", "async-start", "async-done"}
"""Operations that only run others, which are counted themselves."""

_FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "iota", "partition-id"}
_MOVES = {
    *("copy", "reshape", "transpose", "broadcast", "slice", "concatenate", "pad", "reverse", "gather", "select"),
    *("dynamic-slice", "dynamic-update-slice", "convert", "custom-call", "fusion", "copy-start", "copy-done", "sort"),
}

_SLICES = {"dynamic-slice", "gather", "slice"}

_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%(?P<name>[\w.\-]+) = (?P<type>\(.*?\)|\S+) (?P<opcode>[\w\-]+)\(")
_COMPUTATION = re.compile(r"^(?:ENTRY )?%(?P<name>[\w.\-]+) \(.*\{$")
_ARRAY = re.compile(r"(?P<kind>pred|[a-z]+\d+\w*)\[(?P<shape>[\d,]*)\]")
_NAME = re.compile(r"%([\w.\-]+)")


class Operation(NamedTuple):
    """One operation as the program runs it, often a fusion of several.

    Attributes:
        stage: one of `STAGES`, or `OTHER`.
        flops: arithmetic operations, one for each element of an elementwise one; 2 for a multiply and add.
        bytes: read and written, every operand and the result once; of what is changed in place only the changed part.
    """

    stage: str
    flops: float
    bytes: float


class _Instruction(NamedTuple):
    name: str
    opcode: str
    elements: int
    bytes: int
    shape: tuple[int, ...]
    operands: tuple[str, ...]
    text: str


def read_program(text: str, stages: Sequence[str] = STAGES) -> dict[str, Operation]:
    """The operations of a compiled program (`jax.stages.Compiled.as_text`), by their names in traces.

    Operations that do nothing but run others (loops, calls) are left out.
    """
    computations = _computations(text)
    by_name = {one.name: one for body in computations.values() for one in body}
    fused = {called for one in by_name.values() if one.opcode == "fusion" and (called := _called(one))}
    operations = {}
    for name, body in computations.items():
        if name in fused:
            continue
        for one in body:
            if one.opcode in _CONTAINERS | _FREE:
                continue
            inner = computations.get(_called(one) or "", []) if one.opcode == "fusion" else []
            operations[one.name] = Operation(
                _stage(one, inner, stages),
                sum(_flops(part, by_name) for part in inner or [one]),
                _fusion_bytes(one, inner, by_name) if inner else _bytes(one, by_name),
            )
    return operations


def stage_of(op_name: str, stages: Sequence[str] = STAGES) -> str | None:
    """The outermost of the stages in the path of an operation, such as `jit(step)/carve/jit(inverse)/mul`."""
    return next((part for part in op_name.split("/") if part in stages), None)


def _computations(text: str) -> dict[str, list[_Instruction]]:
    computations: dict[str, list[_Instruction]] = {}
    body: list[_Instruction] = []
    for line in text.splitlines():
        if header := _COMPUTATION.match(line):
            body = computations.setdefault(header["name"], [])
        elif found := _INSTRUCTION.match(line):
            body.append(_instruction(line, found))
    return computations


def _instruction(line: str, found: re.Match[str]) -> _Instruction:
    shapes = [
        (_width(array["kind"]), tuple(int(size) for size in array["shape"].split(",") if size))
        for array in _ARRAY.finditer(found["type"])
    ]
    inside, depth = found.end(), 1
    end = inside
    while end < len(line) and depth:
        depth += {"(": 1, ")": -1}.get(line[end], 0)
        end += 1
    return _Instruction(
        found["name"],
        found["opcode"],
        math.prod(shapes[0][1]) if shapes else 0,
        sum(width * math.prod(shape) for width, shape in shapes),
        shapes[0][1] if shapes else (),
        tuple(_NAME.findall(line[inside : end - 1])),
        line[end:],
    )


def _width(kind: str) -> int:
    """Bytes of one element."""
    bits = re.search(r"\d+", kind)
    return max(int(bits.group()) // 8, 1) if bits else 1


def _called(one: _Instruction) -> str | None:
    called = re.search(r"calls=%([\w.\-]+)", one.text)
    return called.group(1) if called else None


def _stage(one: _Instruction, inner: Sequence[_Instruction], stages: Sequence[str]) -> str:
    """The operation's own stage, or else that of most operations fused in it."""
    own, *parts = (_op_name(part) for part in (one, *inner))
    if stage := stage_of(own, stages):
        return stage
    found = Counter(stage for part in parts if (stage := stage_of(part, stages)))
    return found.most_common(1)[0][0] if found else OTHER


def _op_name(one: _Instruction) -> str:
    found = re.search(r'op_name="((?:[^"\\]|\\.)*)"', one.text)
    return found.group(1) if found else ""


def _flops(one: _Instruction, by_name: Mapping[str, _Instruction]) -> float:
    operands = [by_name[name] for name in one.operands if name in by_name]
    if one.opcode == "dot":
        axes = re.search(r"lhs_contracting_dims=\{([\d,]*)\}", one.text)
        contracted = [operands[0].shape[int(axis)] for axis in axes.group(1).split(",") if axis] if axes else []
        return 2.0 * one.elements * math.prod(contracted)
    if one.opcode == "convolution":
        features = re.search(r"dim_labels=\w+_(\w+)->", one.text)
        outputs = operands[1].shape[features.group(1).index("o")] if features else 1
        return 2.0 * one.elements * operands[1].elements / max(outputs, 1)
    if f'custom_call_target="{TARGET}"' in one.text:
        images, expand, _, depthwise, _, project, _ = operands
        pixels, outputs = math.prod(images.shape[:3]), math.prod(one.shape[:3])
        return 2.0 * (pixels * expand.elements + outputs * (depthwise.elements + project.elements))
    if one.opcode in ("reduce", "reduce-window"):
        return float(operands[0].elements) if operands else 0.0
    if one.opcode == "scatter":
        return float(operands[-1].elements) if operands else 0.0
    return 0.0 if one.opcode in _FREE | _MOVES | _CONTAINERS else float(one.elements)


def _bytes(one: _Instruction, by_name: Mapping[str, _Instruction]) -> float:
    """Operands and result, unless most of one of them is not touched."""
    operands = [by_name[name] for name in one.operands if name in by_name]
    if one.opcode == "dynamic-update-slice":
        return 2.0 * operands[1].bytes
    if one.opcode == "scatter":
        # Updated elements are read and written; indices and updates are read.
        return sum(part.bytes for part in operands[1:]) + 2.0 * operands[-1].bytes
    if one.opcode in ("dynamic-slice", "gather", "slice"):
        return 2.0 * one.bytes + sum(part.bytes for part in operands[1:])
    return float(one.bytes + sum(part.bytes for part in operands))


def _fusion_bytes(one: _Instruction, inner: Sequence[_Instruction], by_name: Mapping[str, _Instruction]) -> float:
    """What a fusion reads through its parameters, and what it writes."""
    total, in_place = 0.0, ""
    root = inner[-1]
    while root.opcode in ("bitcast", "copy") and root.operands:
        root = by_name[root.operands[0]]
    if root.opcode in ("dynamic-update-slice", "scatter"):
        total, in_place = _bytes(root, by_name), root.operands[0]
    else:
        total = float(one.bytes)
    for parameter in (part for part in inner if part.opcode == "parameter" and part.name != in_place):
        users = [part for part in inner if parameter.name in part.operands]
        if root.opcode == "scatter" and users == [root]:
            continue
        sliced = [part for part in users if part.opcode in _SLICES and part.operands[0] == parameter.name]
        whole = len(sliced) < len(users)
        total += parameter.bytes if whole else min(parameter.bytes, sum(part.bytes for part in sliced))
    return total
