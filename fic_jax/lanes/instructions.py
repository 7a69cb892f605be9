"""LLVM instructions for one operation, on a scalar or on a vector of lanes (in a thread: of one).

A bool is a mask. With mask registers (AVX-512) it is one bit, LLVM's own type. Without them it is
an integer of the floats' width, all ones or zero: bits would be packed and unpacked at each jump.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from fic_jax.lanes.graph import ZERO, Node, Untranslatable

SIMPLE = {
    "f": {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "neg": "fneg"},
    "i": {"add": "add", "sub": "sub", "mul": "mul", "neg": "neg"},
    "b": {"and": "and_", "or": "or_", "not": "not_", "xor": "xor"},
}
REAL = ("sign", "square", "integer_pow", "is_finite", "exp")  # here for real numbers only
COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
INTRINSIC = {"abs": "fabs", "floor": "floor", "ceil": "ceil", "sqrt": "sqrt"}
EXTREME = {"max": ">", "min": "<"}

# exp(r) = 1 + r + r^2 p(r) on |r| <= ln(2)/2, highest power first: Cephes' for single precision
# (Moshier 1989), Taylor's to 2e-17 for double.
EXP_SINGLE = (1.98756915e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 0.16666665459, 0.5)
EXP_DOUBLE = tuple(float(1 / np.prod(np.arange(1.0, k + 1))) for k in range(13, 1, -1))


class Instructions:
    """Writes operations on numbers of one width, in vectors of `lanes` or alone."""

    def __init__(self, build: ir.IRBuilder, dtype: np.dtype, lanes: int, mask_bits: int) -> None:
        self.build, self.bits, self.lanes = build, 8 * dtype.itemsize, lanes
        self.real = ir.FloatType() if self.bits == 32 else ir.DoubleType()
        self.int, self.bool = ir.IntType(self.bits), ir.IntType(mask_bits)

    def vector(self, of: Any) -> Any:
        """The type of a vector; of a thread's single lane, a scalar."""
        return ir.VectorType(of, self.lanes) if self.lanes > 1 else of

    def alike(self, kind: str, like: Any) -> Any:
        """The type of numbers of a kind, as many as `like` has."""
        scalar = {"f": self.real, "i": self.int, "b": self.bool}[kind]
        return self.vector(scalar) if isinstance(like, ir.VectorType) else scalar

    def constant(self, of: Any, number: Any) -> Any:
        """A number, in each lane if `of` is the type of a vector."""
        many = isinstance(of, ir.VectorType)
        return ir.Constant(of, [number] * self.lanes if many else number)

    def spread(self, value: Any) -> Any:
        """A vector of one scalar."""
        if self.lanes == 1:
            return value
        undefined = ir.Constant(self.vector(value.type), ir.Undefined)
        first = self.build.insert_element(undefined, value, ir.IntType(32)(0))
        zeros = self.constant(self.vector(ir.IntType(32)), 0)
        return self.build.shuffle_vector(first, undefined, zeros)

    # ---- Conditions, comparisons, functions ------------------------------------------------------

    def mask(self, condition: Any) -> Any:
        """Bits as a mask."""
        return self.widened(condition, self.alike("b", condition.type))

    def truth(self, mask: Any) -> Any:
        """A mask as bits: its sign, which a blend reads."""
        if self.bool.width == 1:
            return mask
        return self.build.icmp_signed("<", mask, self.constant(mask.type, 0))

    def widened(self, mask: Any, of: Any) -> Any:
        """A mask, or bits, as integers of a type: all ones or zero."""
        return mask if mask.type == of else self.build.sext(mask, of)

    def any_lane(self, mask: Any) -> Any:
        """Whether any lane meets a mask, as one bit."""
        truth = self.truth(mask)
        if not isinstance(mask.type, ir.VectorType):
            return truth
        lanes = self.build.bitcast(truth, ir.IntType(self.lanes))
        return self.build.icmp_unsigned("!=", lanes, lanes.type(0))

    def compared(self, how: str, kind: str, x: Any, y: Any) -> Any:
        """A comparison as a mask; only `!=` is true of NaN."""
        build = self.build
        if kind == "f":
            compare = build.fcmp_unordered if how == "!=" else build.fcmp_ordered
        else:
            compare = build.icmp_signed if kind == "i" else build.icmp_unsigned  # true is all ones
        return self.mask(compare(how, x, y))

    def extreme(self, how: str, kind: str, x: Any, y: Any) -> Any:
        """Maximum or minimum; NaN if one is NaN; of two zeros the second one."""
        one = self.chosen(self.compared(how, kind, x, y), x, y)
        if kind != "f":
            return one
        unknown = self.build.fcmp_unordered("uno", x, x)  # the select gives y where y is NaN
        return self.build.select(unknown, x, one)

    def chosen(self, mask: Any, yes: Any, no: Any) -> Any:
        """One of two values that the condition compares.

        In a thread floats are chosen as integers: LLVM would make PTX's min or max of a comparison
        and a choice of floats, and these order -0 before +0.
        """
        if self.lanes > 1 or yes.type != self.real:
            return self.build.select(self.truth(mask), yes, no)
        bits = [self.build.bitcast(value, self.int) for value in (yes, no)]
        return self.build.bitcast(self.build.select(self.truth(mask), *bits), self.real)

    def where(self, mask: Any, value: Any) -> Any:
        """The value in the lanes of the mask, 0 (all bits) in the others."""
        whole = self.alike("i", value.type)
        bits = self.build.and_(self.widened(mask, whole), self.build.bitcast(value, whole))
        return self.build.bitcast(bits, value.type)

    def intrinsic(self, name: str, *args: Any) -> Any:
        """An LLVM intrinsic on floats."""
        return self.called(f"{name}.{self.many(args[0].type)}f{self.bits}", args[0].type, *args)

    def saturated(self, x: Any, of: Any) -> Any:
        """Floats as integers, saturating; 0 for NaN."""
        many = self.many(of)
        return self.called(f"fptosi.sat.{many}i{self.bits}.{many}f{self.bits}", of, x)

    def called(self, name: str, of: Any, *args: Any) -> Any:
        """A call of an LLVM intrinsic, declared at its first use."""
        module, types = self.build.module, [a.type for a in args]
        known = module.globals.get(f"llvm.{name}")
        function = known or ir.Function(module, ir.FunctionType(of, types), f"llvm.{name}")
        return self.build.call(function, args)

    def many(self, of: Any) -> str:
        """The prefix of a type in an intrinsic's name."""
        return f"v{self.lanes}" if isinstance(of, ir.VectorType) else ""

    # ---- Operations of the graph, `_name` writes `name` ------------------------------------------

    def of(self, node: Node, args: Sequence[Any]) -> Any:
        """The value of a node from those of its operands."""
        if node.op == "constant":
            number = -int(node.value) if node.kind == "b" else node.value
            return self.constant(self.alike(node.kind, None), number)
        if not node.args:
            raise Untranslatable(f"the operation {node.op} without operands")
        op, kind = node.op, node.args[-1].kind
        if op in SIMPLE[kind]:
            return getattr(self.build, SIMPLE[kind][op])(*args)
        if op in COMPARED:
            return self.compared(COMPARED[op], kind, *args)
        if op in EXTREME:
            return self.extreme(EXTREME[op], kind, *args)
        if op in INTRINSIC and kind == "f":
            return self.intrinsic(INTRINSIC[op], *args)
        method = getattr(self, f"_{op}", None)
        if method is None or (kind != "f" and op in REAL):
            raise Untranslatable(f"the operation {op} on numbers of kind {kind}")
        return method(node, *args)

    def _select_n(self, node: Node, condition: Any, no: Any, yes: Any) -> Any:
        """A blend, or if one arm is zero a bitwise and, which is cheaper."""
        compared, if_not, if_so = node.args
        if self.bool.width > 1 and node.kind != "b":
            if _no_bits(if_not):
                return self.where(condition, yes)
            if _no_bits(if_so):
                return self.where(self.build.not_(condition), no)
        if {if_not, if_so}.isdisjoint(compared.args):
            return self.build.select(self.truth(condition), yes, no)
        return self.chosen(condition, yes, no)

    def _fma(self, node: Node, x: Any, y: Any, z: Any) -> Any:
        product, rest = node.value.split()
        x = self.build.fneg(x) if product == "-" else x
        return self.intrinsic("fmuladd", x, y, self.build.fneg(z) if rest == "-" else z)

    def _convert(self, node: Node, x: Any) -> Any:
        kinds = node.args[0].kind + node.kind
        of = self.alike(node.kind, x.type)
        if kinds[0] == "b":
            one = self.build.neg(self.widened(x, self.alike("i", x.type)))
            return one if kinds == "bi" else self.build.sitofp(one, of)
        if kinds == "if":
            return self.build.sitofp(x, of)
        if kinds == "fi":
            return self.saturated(x, of)
        return self.compared("!=", kinds[0], x, self.constant(x.type, ZERO[kinds[0]]))

    def _sign(self, _: Node, x: Any) -> Any:
        zero, one = self.constant(x.type, 0.0), self.constant(x.type, 1.0)
        none = self.build.fcmp_unordered("==", x, zero)  # NaN stays as well
        return self.build.select(none, x, self.intrinsic("copysign", one, x))

    def _square(self, _: Node, x: Any) -> Any:
        return self.build.fmul(x, x)

    def _integer_pow(self, node: Node, x: Any) -> Any:
        if node.value not in (2, 3):
            raise Untranslatable(f"the power {node.value}")
        square = self.build.fmul(x, x)
        return square if node.value == 2 else self.build.fmul(square, x)

    def _is_finite(self, _: Node, x: Any) -> Any:
        infinite = self.constant(x.type, float("inf"))
        return self.mask(self.build.fcmp_ordered("<", self.intrinsic("fabs", x), infinite))

    def _exp(self, _: Node, x: Any) -> Any:
        """exp(x) = 2^n exp(r) with |r| <= ln(2)/2; 0 where the result would not be normal."""
        build, single = self.build, self.bits == 32
        number = lambda c: self.constant(x.type, c)  # noqa: E731
        fma = lambda p, q, r: self.intrinsic("fmuladd", p, q, r)  # noqa: E731
        digits, powers = (23, EXP_SINGLE) if single else (52, EXP_DOUBLE)
        # ln 2 in two parts, the first so short that n times it is exact
        long = 0.693359375 if single else 0.693145751953125
        short = -2.12194440e-4 if single else 1.42860682030941723212e-6
        least, most = (-87.3, 88.7228) if single else (-708.3, 709.7827)
        shift = number(1.5 * 2.0**digits)  # adding it rounds to a whole number, in the last bits
        shifted = build.fadd(build.fmul(x, number(1.4426950408889634)), shift)
        n = build.fsub(shifted, shift)
        r = fma(n, number(-short), fma(n, number(-long), x))
        square = build.fmul(r, r)
        p, *pairs = (
            fma(number(c), r, number(d)) for c, d in zip(powers[::2], powers[1::2], strict=True)
        )
        for pair in pairs:  # side by side: half the latency of Horner's rule
            p = fma(p, square, pair)
        p = build.fadd(fma(square, p, r), number(1.0))
        whole = self.alike("i", x.type)
        exponent = build.shl(build.bitcast(shifted, whole), self.constant(whole, digits))
        scaled = build.bitcast(build.add(build.bitcast(p, whole), exponent), x.type)
        scaled = build.select(build.fcmp_ordered("<", x, number(least)), number(0.0), scaled)
        scaled = build.select(build.fcmp_ordered(">", x, number(most)), number(np.inf), scaled)
        return build.select(build.fcmp_unordered("uno", x, x), x, scaled)


def _no_bits(node: Node) -> bool:
    """Whether a node is a constant whose bits are all 0, unlike -0."""
    return node.op == "constant" and repr(node.value) == repr(ZERO[node.kind])
