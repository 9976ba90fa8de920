"""Reads pickles that hold plain values, without running anything that they name.

A pickle is a program that may call any function. This module carries out only the instructions that build lists,
dicts, tuples, text, bytes, numbers, and NumPy arrays of numbers or of such values. Any other instruction and any other
name is an error. Python's own `pickle` is not used, since even without those names it allocates as much memory as a
pickle asks for.
"""

from __future__ import annotations

import math
import re
import struct
from typing import Any

import numpy as np

from enerf_ns.dataparsers.recording.errors import shortened

MOST_OPERATIONS = 2**24
"""Most instructions of a pickle. A minute of EVIMO2 with twenty objects has 15 million."""

MOST_HELD = 10_000
"""Most values that wait to become a part of others, which limits how deep lists and dicts nest. Python adds at most
1000 items to a list or dict at a time."""

LONGEST_NAME = 200
"""Most bytes of the name of a module or function."""


def loads(content: bytes) -> Any:
    """Returns the value of a pickle.

    Args:
        content: A pickle of protocol 2 to 5.

    Returns:
        None, a bool, int, float, str, bytes, list, tuple, dict, or a NumPy array of numbers. An array of other values
        becomes the list of them.

    Raises:
        ValueError: The pickle is damaged, names or does anything else, has more than `MOST_OPERATIONS` instructions,
            holds a list or dict in two places, or nests them deeper than `MOST_HELD`. The message can follow "FILE
            holds".
    """
    try:
        return _run(content)
    except (IndexError, KeyError, TypeError, struct.error, UnicodeDecodeError) as error:
        raise ValueError("a pickle that is damaged") from error


def _run(content: bytes) -> Any:
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    double, word = struct.Struct(">d").unpack_from, struct.Struct("<I").unpack_from
    push = stack.append
    place = num_remembered = 0

    def taken(width: int) -> bytes:
        """Returns bytes that come after their length, a number of so many bytes."""
        nonlocal place
        start = place + width
        place = start + int.from_bytes(content[place:start], "little")
        if place > len(content):
            raise ValueError("a pickle that is cut off")
        return content[start:place]

    def since_mark() -> list[Any]:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    def remember(number: int) -> None:
        nonlocal num_remembered
        num_remembered += 1
        if not isinstance(stack[-1], list | dict):
            memo[number] = stack[-1]

    def recall(number: int) -> None:
        if number not in memo:
            raise ValueError("a pickle that is damaged, or that holds a list or dict in two places")
        push(memo[number])

    for _ in range(MOST_OPERATIONS):
        operation = content[place]
        place += 1
        if operation == BINGET:
            recall(content[place])
            place += 1
        elif operation == BINFLOAT:
            push(double(content, place)[0])
            place += 8
        elif operation == EMPTY_DICT:
            push({})
        elif operation == MARK:
            marks.append(len(stack))
        elif operation == SETITEMS:
            items = since_mark()
            stack[-1] |= zip(items[::2], items[1::2], strict=True)
        elif operation == LONG_BINPUT:
            remember(word(content, place)[0])
            place += 4
        elif operation == MEMOIZE:
            remember(num_remembered)
        elif operation == BINPUT:
            remember(content[place])
            place += 1
        elif operation == LONG_BINGET:
            recall(word(content, place)[0])
            place += 4
        elif operation in TEXTS:
            push(taken(TEXTS[operation]).decode())
        elif operation in BYTES:
            push(taken(BYTES[operation]))
        elif operation == LONG1:
            push(int.from_bytes(taken(1), "little", signed=True))
        elif operation in INTEGERS:
            width = INTEGERS[operation]
            push(int.from_bytes(content[place : place + width], "little", signed=width == 4))
            place += width
        elif operation == EMPTY_LIST:
            push([])
        elif operation in CONSTANTS:
            push(CONSTANTS[operation])
        elif operation == APPENDS:
            items = since_mark()
            _list(stack[-1]).extend(items)
        elif operation == APPEND:
            item = stack.pop()
            _list(stack[-1]).append(item)
        elif operation == SETITEM:
            item, key = stack.pop(), stack.pop()
            stack[-1] |= {key: item}
        elif operation in TUPLES:
            start = len(stack) - TUPLES[operation]
            stack[start:] = [tuple(stack[start:])]
        elif operation == TUPLE:
            push(tuple(since_mark()))
        elif operation == GLOBAL:
            module, name = (line.decode() for line in content[place : place + 2 * LONGEST_NAME].split(b"\n")[:2])
            push(_Name(module, name))
            place += len(f"{module}\n{name}\n".encode())
        elif operation == STACK_GLOBAL:
            name = stack.pop()
            push(_Name(stack.pop(), name))
        elif operation == REDUCE:
            arguments = stack.pop()
            push(_called(stack.pop(), arguments))
        elif operation == BUILD:
            state = stack.pop()
            push(_built(stack.pop(), state))
        elif operation in SKIPPED:
            place += SKIPPED[operation]
        elif operation == STOP:
            return stack.pop()
        else:
            raise ValueError(f"a pickle with the instruction {operation:#04x}, which plain values do not need")
        if len(stack) > MOST_HELD or len(marks) > MOST_HELD:
            raise ValueError(f"a pickle that nests values deeper than {MOST_HELD:,}")
    raise ValueError(f"a pickle of more than {MOST_OPERATIONS:,} instructions")


MARK, STOP, BINGET, LONG_BINGET, BINPUT, LONG_BINPUT, MEMOIZE = b"(.hjqr\x94"
EMPTY_DICT, SETITEM, SETITEMS, EMPTY_LIST, APPEND, APPENDS, TUPLE = b"}su]aet"
BINFLOAT, LONG1, GLOBAL, STACK_GLOBAL, REDUCE, BUILD = b"G\x8ac\x93Rb"
CONSTANTS: dict[int, Any] = {ord("N"): None, 0x88: True, 0x89: False, ord(")"): ()}
INTEGERS = {ord("K"): 1, ord("M"): 2, ord("J"): 4}
TEXTS = {0x8C: 1, ord("X"): 4, 0x8D: 8}
BYTES = {ord("C"): 1, ord("B"): 4, 0x8E: 8}
"""Instructions for whole numbers, with their width in bytes; for text and bytes, with the width of their length."""
TUPLES = {0x85: 1, 0x86: 2, 0x87: 3}
SKIPPED = {0x80: 1, 0x95: 8}
"""Instructions that build nothing: the protocol, and the length of a part. With the number of bytes after them."""


class _Name:
    """A function or class of NumPy that plain arrays need, which is never looked up.

    Raises:
        ValueError: The name is another one.
    """

    def __init__(self, module: str, name: str):
        if module.replace("numpy._core.", "numpy.core.") not in KNOWN.get(name, ()):
            raise ValueError(
                f"a pickle that names {shortened(module)}.{shortened(name)}, which is not run; only plain values and "
                "arrays of numbers are read"
            )
        self.name = name


KNOWN = {
    "_reconstruct": ("numpy.core.multiarray",),
    "scalar": ("numpy.core.multiarray",),
    "ndarray": ("numpy",),
    "dtype": ("numpy",),
}
"""Modules of each function and class that a pickle may name."""


class _Array:
    """An array before its content is known."""


class _Type:
    """A type of NumPy, such as f8, before its byte order is known."""

    def __init__(self, name: str, order: str = "="):
        self.name, self.order = name, order

    def numbers(self, content: bytes) -> np.ndarray:
        """Returns the numbers in some bytes; raises ValueError if this is no type of numbers."""
        if not re.fullmatch("[biuf][1248]", self.name) or self.order not in ("<", ">", "=", "|"):
            raise ValueError(f"a pickle with an array of type {shortened(self.name)}, but numbers were expected")
        return np.frombuffer(content, np.dtype(self.order + self.name))


def _called(function: _Name, arguments: tuple[Any, ...]) -> Any:
    if function.name == "_reconstruct":
        return _Array()  # of no size yet, whatever the arguments ask for
    if function.name == "dtype":
        return _Type(_text(arguments[0]))
    if function.name == "scalar":
        kind, content = arguments
        return kind.numbers(content)[0].item()
    raise ValueError(f"a pickle that calls {function.name}, which plain values do not need")


def _built(value: Any, state: Any) -> Any:
    """Returns the value with its content, as `__setstate__` of NumPy's classes takes it."""
    if isinstance(value, _Type):
        value.order = _text(state[1])
        return value
    if not isinstance(value, _Array):
        raise ValueError("a pickle that sets the state of an object, but plain values were expected")
    _, shape, kind, by_column, content = state
    if isinstance(content, list):
        found = len(content)
    else:
        content = kind.numbers(content)
        found = len(content)
    if found != math.prod(shape):
        raise ValueError(f"a pickle with an array of shape {shortened(str(shape))}, but of {found:,} values")
    return content if isinstance(content, list) else content.reshape(shape, order="F" if by_column else "C")


def _list(value: Any) -> list:
    if type(value) is not list:
        raise TypeError(type(value).__name__)
    return value


def _text(value: Any) -> str:
    if type(value) is not str:
        raise TypeError(type(value).__name__)
    return value
