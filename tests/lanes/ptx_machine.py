"""An interpreter of PTX, one thread at a time, for the instructions that LLVM writes for kernels.

It follows NVIDIA's "Parallel Thread Execution ISA". Each operation on floats is rounded once. Any
other instruction, or any other modifier (as `.ftz` or `.approx`), is an error.
"""

import ctypes
import math
import operator
import re
from fractions import Fraction

import numpy as np

FLOATS = {"f32": np.float32, "f64": np.float64}
BITS = {"f32": np.uint32, "f64": np.uint64}


class Program:
    """The kernel of a PTX text."""

    def __init__(self, text):
        code = re.sub(r"//.*", "", text)
        (head,) = re.findall(r"\.visible \.entry run\((.*?)\)", code, re.DOTALL)
        parameters = re.findall(r"\.param \.(u32|u64)( \.ptr)?(?: \.align 1)? (\w+)", head)
        self.parameters = [(of, bool(pointer)) for of, pointer, _ in parameters]
        self.names = [f"[{name}]" for *_, name in parameters]
        self.target = re.search(r"^\.target (\w+)", code, re.MULTILINE)[1]
        self.threads = int(re.search(r"^\.maxntid (\d+)", code, re.MULTILINE)[1])
        body = code[code.index("{") + 1 : code.rindex("}")]
        self.steps, self.labels, self.instructions = [], {}, []
        for line in filter(None, map(str.strip, body.splitlines())):
            if line.endswith(":"):
                self.labels[line[:-1]] = len(self.steps)
            elif not line.startswith(".reg"):
                guard, name, operands = re.fullmatch(r"(?:@(\S+) )?(\S+)\s*(.*);", line).groups()
                self.instructions.append(name)
                self.steps.append((guard, *_step(name, re.split(r",\s*", operands))))

    def run(self, arguments, special, check=lambda address, size: None):
        """Execute a thread, with the numbers of the parameters and of the special registers.

        `check` gets the address and the size of all that is loaded or stored.
        """
        registers = {**special, **dict(zip(self.names, arguments, strict=True))}
        at = 0
        with np.errstate(all="ignore"):
            while True:
                guard, kind, compute, target, sources = self.steps[at]
                at += 1
                if guard and not registers[guard]:
                    continue
                if kind == "ret":
                    return
                if kind == "jump":
                    at = self.labels[target]
                    continue
                values = [read(registers) for read in sources]
                if kind == "memory":
                    values = [check, *values]
                registers[target] = compute(*values)


def _step(name, operands):
    """Kind of an instruction, its function, the register that it writes, readers of its operands.

    A jump has its label instead of the register.
    """
    if name == "ret":
        return "ret", None, None, ()
    if name in ("bra", "bra.uni"):
        return "jump", None, operands[0], ()
    if name.startswith(("ld.global.", "st.global.")):
        moves, of = name[:2], name.rpartition(".")[2]
        if moves == "ld":
            return "memory", _loaded(of), operands[0], [_place(operands[1])]
        return "memory", _stored(of), None, [_place(operands[0]), _reader(operands[1], of)]
    target, *sources = operands
    compute, types = operation(name, len(sources))
    readers = [_reader(source, of) for source, of in zip(sources, types, strict=True)]
    return "operation", compute, target, readers


# ---- Floats --------------------------------------------------------------------------------------


def fused(x, y, z):
    """x y + z, rounded once."""
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return x * y + z
    if type(x) is np.float32:
        return np.float32(_rounded_to_odd(float(x) * float(y), float(z)))
    (a, b), (c, d), (e, f) = (v.as_integer_ratio() for v in (x, y, z))
    above, below = a * c * f + e * b * d, b * d * f
    if above == 0:  # the sum of numbers that cancel is +0
        return x * y + z if x == 0 or y == 0 else np.float64(0.0)
    try:
        return np.float64(above / below)  # Python rounds the quotient of integers once
    except OverflowError:
        return np.float64(math.inf if above > 0 else -math.inf)


def _rounded_to_odd(product, z):
    """The sum of two doubles; if inexact its odd neighbour, so that a second rounding is right.

    (Boldo and Melquiond 2008.) The product of two singles is exact as a double.
    """
    total = product + z
    rest = Fraction(product) + Fraction(z) - Fraction(total)
    if rest and not np.float64(total).view(np.int64) & 1:
        return math.nextafter(total, math.inf if rest > 0 else -math.inf)
    return total


def lesser(x, y):
    """The lesser float; the other one if one is NaN; of two zeros the negative one."""
    if math.isnan(x) or math.isnan(y):
        return y if math.isnan(x) else x
    if x == y:
        return x if np.signbit(x) else y
    return min(x, y)


# ---- Operations, by name without type ------------------------------------------------------------

ROUNDED = {  # to nearest, each once
    "add.rn": operator.add,
    "sub.rn": operator.sub,
    "mul.rn": operator.mul,
    "div.rn": operator.truediv,
    "rcp.rn": lambda x: type(x)(1) / x,
    "sqrt.rn": np.sqrt,
    "fma.rn": fused,
}
EXACT = {
    "neg": operator.neg,
    "abs": abs,
    "copysign": lambda sign_of, x: np.copysign(x, sign_of),
    "min": lesser,
    "max": lambda x, y: -lesser(-x, -y),
}
WHOLE = {  # the result is cut to its width
    "add": operator.add,
    "sub": operator.sub,
    "mul.lo": operator.mul,
    "mul.wide": operator.mul,
    "mad.lo": lambda x, y, z: x * y + z,
    "neg": operator.neg,
    "min": min,
    "max": max,
    "shl": lambda x, n: x << min(n, 64),
    "shr": lambda x, n: x >> min(n, 64),
    "and": operator.and_,
    "or": operator.or_,
    "xor": operator.xor,
    "mov": operator.pos,
    "ld.param": operator.pos,
    "cvta.to.global": operator.pos,  # global addresses are generic ones
}
LOGICAL = {
    "and": operator.and_,
    "or": operator.or_,
    "xor": operator.xor,
    "not": operator.not_,
    "mov": bool,
}
COMPARED = {
    "eq": operator.eq,
    "ne": operator.ne,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
}


def operation(name, n):
    """The function of an instruction with n operands, and their types. Raises if it is unknown."""
    stem, _, of = name.rpartition(".")
    op, _, how = stem.partition(".")
    alike = n * (of,)
    if of in FLOATS and stem in {**ROUNDED, **EXACT}:
        return {**ROUNDED, **EXACT}[stem], alike
    if op == "setp":
        return _comparison(how, of), alike
    if op == "cvt":
        return _conversion(how, of), alike
    if stem == "selp":
        return (lambda x, y, chosen: x if chosen else y), (of, of, "pred")
    if of == "pred" and stem in LOGICAL:
        return LOGICAL[stem], alike
    if re.fullmatch(r"[sub](16|32|64)", of) and stem in WHOLE:
        width = int(of[1:]) * (2 if stem == "mul.wide" else 1)
        return _cut(WHOLE[stem], width), (of, "u32") if op in ("shl", "shr") else alike
    raise NotImplementedError(name)


def _comparison(how, of):
    """Ordered comparisons are false of NaN, unordered ones (as `ltu`) are true."""
    if of not in FLOATS:
        return COMPARED[how]
    if how == "nan":
        return lambda x, y: math.isnan(x) or math.isnan(y)
    if how == "num":
        return lambda x, y: not (math.isnan(x) or math.isnan(y))
    unordered, compare = len(how) == 3, COMPARED[how[:2]]
    return lambda x, y: unordered if math.isnan(x) or math.isnan(y) else bool(compare(x, y))


def _conversion(how, of):
    """Floats to whole floats, to integers and from them; integers to another width."""
    *rounding, to = how.split(".")
    if of == to and of in FLOATS and rounding in (["rmi"], ["rpi"]):
        return np.floor if rounding == ["rmi"] else np.ceil
    if to in FLOATS and of == f"s{to[1:]}" and rounding == ["rn"]:
        return FLOATS[to]
    if of in FLOATS and to == f"s{of[1:]}" and rounding == ["rzi"]:
        return lambda x: _saturated(x, int(to[1:]))
    if not rounding and {to[0], of[0]} <= {"s", "u"}:
        return _cut(operator.pos, int(to[1:]))
    raise NotImplementedError(f"cvt.{how}.{of}")


def _saturated(x, bits):
    """The integer part of a float; of NaN 0 in 32 bits, and the least integer in 64."""
    least = -(2 ** (bits - 1))
    if math.isnan(x):
        return 0 if bits == 32 else least % 2**bits
    if np.isinf(x):
        whole = least if x < 0 else -least - 1
    else:
        whole = min(max(math.trunc(float(x)), least), -least - 1)
    return whole % 2**bits


def _cut(compute, width):
    """The function with its result as bits of a register."""
    return lambda *values: compute(*values) % 2**width


# ---- Registers and memory ------------------------------------------------------------------------
# A register has a NumPy float, a bool, or bits as an integer from 0 on: it has no type in PTX.


def _reader(source, of):
    """What reads an operand, a register or a number, as a value of a type."""
    value_of = _as_type(of)
    if source.startswith(("%", "[")):
        return lambda registers: value_of(registers[source])
    if source.startswith(("0f", "0d")):
        bits = int(source[2:], 16)
    else:
        bits = int(source)
    if of == "pred":
        return lambda registers: bool(bits)
    number = value_of(bits % 2 ** int(of[1:]))
    return lambda registers: number


def _as_type(of):
    """What gives a register's value as a value of a type."""
    if of == "pred":
        return bool
    if of in FLOATS:
        real, whole = FLOATS[of], BITS[of]
        return lambda value: value if type(value) is real else whole(value).view(real)
    sign, modulus = of[0] == "s", 2 ** int(of[1:])

    def whole_number(value):
        bits = int(value.view(f"u{value.itemsize}")) if isinstance(value, np.floating) else value
        bits %= modulus
        return bits - modulus if sign and bits >= modulus // 2 else bits

    return whole_number


def _place(operand):
    """What reads an address, [%register] or [%register+offset]."""
    register, offset = re.fullmatch(r"\[(%\w+)(?:\+(\d+))?\]", operand).groups()
    return lambda registers: registers[register] + int(offset or 0)


def _c_type(of):
    return {8: ctypes.c_uint8, 32: ctypes.c_uint32, 64: ctypes.c_uint64}[int(of[1:])]


def _loaded(of):
    c_type, value_of = _c_type(of), _as_type(of)

    def load(check, address):
        check(address, ctypes.sizeof(c_type))
        bits = value_of(c_type.from_address(address).value)
        return bits % 2**64  # the sign fills the register

    return load


def _stored(of):
    c_type = _c_type(of)

    def store(check, address, bits):
        check(address, ctypes.sizeof(c_type))
        c_type.from_address(address).value = bits

    return store
