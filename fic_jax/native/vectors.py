"""LLVM's words for a graph: each scalar becomes a vector of scenarios, a uniform one stays scalar.

Conditions are integers of the numbers' width, all ones or zero: one bit a scenario, LLVM's own
type, is packed and unpacked at every jump on processors without mask registers.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from fic_jax.native.graph import ZERO, Branch, Loop, Node, Untranslatable, capture, live, ordered

SIMPLE = {
    "f": {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "neg": "fneg"},
    "i": {"add": "add", "sub": "sub", "mul": "mul", "neg": "neg"},
    "b": {"and": "and_", "or": "or_", "not": "not_", "xor": "xor"},
}
REAL = ("sign", "square", "integer_pow", "is_finite", "exp")  # here for real numbers only
COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
INTRINSIC = {"abs": "fabs", "floor": "floor", "ceil": "ceil", "sqrt": "sqrt"}
INT32, INT64 = ir.IntType(32), ir.IntType(64)

# exp(r) = 1 + r + r^2 p(r) on |r| <= ln(2)/2, highest power first: Cephes' for single precision
# (Moshier 1989), Taylor's to 2e-17 for double.
EXP_SINGLE = (
    1.9875691500e-4,
    1.3981999507e-3,
    8.3334519073e-3,
    4.1665795894e-2,
    1.6666665459e-1,
    0.5,
)
EXP_DOUBLE = tuple(float(1 / np.prod(np.arange(1.0, k + 1))) for k in range(13, 1, -1))


def kernel(roots: Sequence[Node], n_columns: int, dtype: np.dtype, lanes: int) -> str:
    """LLVM IR of `run(columns, results, stride, first, last, dt)` for graphs after `branch_out`.

    columns[i * stride + j] is quantity i of scenario j, results alike; integers and conditions are
    written in the numbers' width. Scenarios first..last, in whole vectors, are computed.
    """
    return _Writer(roots, dtype, lanes).function(roots, n_columns)


def _no_bits(node: Node) -> bool:
    """Whether a node is a constant whose bits are all 0, unlike -0."""
    return node.op == "constant" and repr(node.value) == repr(ZERO[node.kind])


class _Writer:
    """Builder, types, and the values of the nodes computed so far."""

    def __init__(self, roots: Sequence[Node], dtype: np.dtype, lanes: int) -> None:
        self.bits, self.lanes = 8 * dtype.itemsize, lanes
        self.real = ir.FloatType() if self.bits == 32 else ir.DoubleType()
        self.int = ir.IntType(self.bits)
        self.module = ir.Module("fic_jax")
        self.live = live(roots)
        capture(self.live)
        self.values: dict[Node, Any] = {}
        self.spread: dict[Node, Any] = {}  # uniform ones as vectors

    # ---- The function ----------------------------------------------------------------------------

    def function(self, roots: Sequence[Node], n_columns: int) -> str:
        pointer = self.real.as_pointer()
        types = [pointer, pointer, INT64, INT64, INT64, self.real]
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), types), "run")
        # or values that wait in memory lie across two lines of the cache, depending on the process
        function.attributes.alignstack = 64
        function.attributes.add("nounwind")  # llvmlite drops an alignment that stands alone
        columns, results, stride, first, last, dt = function.args
        before, turn, after = map(function.append_basic_block, ("before", "vector", "after"))
        self.b = b = ir.IRBuilder(before)
        b.branch(turn)
        b.position_at_end(turn)
        at = b.phi(INT64)
        at.add_incoming(first, before)

        def place(base: Any, i: int) -> Any:
            offset = b.add(b.mul(stride, INT64(i)), at)
            return b.bitcast(b.gep(base, [offset]), self.vector(self.real).as_pointer())

        for node in self.live:
            if node.op == "input":
                whole = node.value < n_columns
                value = b.load(place(columns, node.value), align=self.bits // 8) if whole else dt
                self.define(node, value)
        self.compute(roots)
        for i, root in enumerate(roots):
            value = b.bitcast(self.get(root, uniform=False), self.vector(self.real))
            b.store(value, place(results, i), align=self.bits // 8)
        following = b.add(at, INT64(self.lanes))
        at.add_incoming(following, b.block)
        b.cbranch(b.icmp_signed("<", following, last), turn, after)
        b.position_at_end(after)
        b.ret_void()
        return str(self.module)

    def compute(self, roots: Iterable[Node]) -> None:
        """Everything the roots need that isn't there yet."""
        for node in ordered(roots, lambda n: () if n in self.values else n.needs()):
            if node in self.values:
                continue
            if isinstance(node.of, Loop):
                self.loop(node.of)
            elif isinstance(node.of, Branch):
                self.branch(node.of)
            else:
                self.define(node, self.operation(node))

    def loop(self, loop: Loop) -> None:
        """A loop and its results."""
        b, before = self.b, self.b.block
        phis = [n for n in self.live if n.op == "phi" and n.of is loop]
        results = [n for n in self.live if n.op == "result" and n.of is loop]
        inits = [self.get(loop.inits[p.value], p.uniform) for p in phis]
        turn, after = b.append_basic_block("turn"), b.append_basic_block("after")
        b.branch(turn)
        b.position_at_end(turn)
        k = b.phi(INT32)
        carried = [b.phi(init.type) for init in inits]
        for phi, value in zip(phis, carried, strict=True):
            self.define(phi, value)
        self.compute(loop.outs[i] for i in sorted({n.value for n in (*phis, *results)}))
        outs = [self.get(loop.outs[p.value], p.uniform) for p in phis]
        found = [self.get(loop.outs[r.value], r.uniform) for r in results]
        following = b.add(k, INT32(1))
        starts, nexts = [INT32(0), *inits], [following, *outs]
        for value, start, out in zip([k, *carried], starts, nexts, strict=True):
            value.add_incoming(start, before)
            value.add_incoming(out, b.block)
        b.cbranch(b.icmp_signed("<", following, INT32(loop.length)), turn, after)
        b.position_at_end(after)
        for result, value in zip(results, found, strict=True):
            self.define(result, value)

    def branch(self, branch: Branch) -> None:
        """A branch and its results."""
        b = self.b
        results = [n for n in self.live if n.op == "result" and n.of is branch]
        instead = [self.get(branch.otherwise[r.value], uniform=False) for r in results]
        needed = self.truth(self.get(branch.condition, branch.condition.uniform))
        if not branch.condition.uniform:
            lanes = b.bitcast(needed, ir.IntType(self.lanes))
            needed = b.icmp_unsigned("!=", lanes, lanes.type(0))
        before, then, after = b.block, *map(b.append_basic_block, ("needed", "after"))
        b.cbranch(needed, then, after)
        b.position_at_end(then)
        self.compute(branch.outs[r.value] for r in results)
        found = [self.get(branch.outs[r.value], uniform=False) for r in results]
        then = b.block
        b.branch(after)
        b.position_at_end(after)
        for result, value, other in zip(results, found, instead, strict=True):
            either = b.phi(value.type)
            either.add_incoming(value, then)
            either.add_incoming(other, before)
            self.define(result, either)

    # ---- Values ----------------------------------------------------------------------------------

    def define(self, node: Node, value: Any) -> None:
        """Note a node's value; a uniform one is spread over a vector at once, outside of loops."""
        self.values[node] = value
        if node.uniform and not isinstance(value, ir.Constant):
            undefined = ir.Constant(self.vector(value.type), ir.Undefined)
            first = self.b.insert_element(undefined, value, INT32(0))
            zeros = ir.Constant(self.vector(INT32), [0] * self.lanes)
            self.spread[node] = self.b.shuffle_vector(first, undefined, zeros)

    def get(self, node: Node, uniform: bool) -> Any:
        """The value of a node, as a scalar or as a vector."""
        value = self.values[node]
        if uniform or not node.uniform:
            return value
        if isinstance(value, ir.Constant):
            return self.constant(self.vector(value.type), value.constant)
        return self.spread[node]

    def vector(self, of: Any) -> Any:
        return ir.VectorType(of, self.lanes)

    def alike(self, kind: str, like: Any) -> Any:
        """The type of numbers of a kind, as many as `like` has."""
        scalar = self.real if kind == "f" else self.int
        return self.vector(scalar) if isinstance(like, ir.VectorType) else scalar

    def constant(self, of: Any, number: Any) -> Any:
        many = isinstance(of, ir.VectorType)
        return ir.Constant(of, [number] * self.lanes if many else number)

    def mask(self, condition: Any) -> Any:
        """LLVM's condition as ours."""
        return self.b.sext(condition, self.alike("b", condition.type))

    def truth(self, mask: Any) -> Any:
        """Our condition as LLVM's: its sign, which is what a blend reads."""
        return self.b.icmp_signed("<", mask, self.constant(mask.type, 0))

    def intrinsic(self, name: str, *args: Any) -> Any:
        of = args[0].type
        many = f"v{self.lanes}" if isinstance(of, ir.VectorType) else ""
        full = f"llvm.{name}.{many}f{self.bits}"
        known = self.module.globals.get(full)
        function = known or ir.Function(self.module, ir.FunctionType(of, [of] * len(args)), full)
        return self.b.call(function, args)

    def saturated(self, x: Any, of: Any) -> Any:
        """Real numbers as whole ones: the nearest there is, 0 for NaN."""
        many = f"v{self.lanes}" if isinstance(of, ir.VectorType) else ""
        full = f"llvm.fptosi.sat.{many}i{self.bits}.{many}f{self.bits}"
        known = self.module.globals.get(full)
        function = known or ir.Function(self.module, ir.FunctionType(of, [x.type]), full)
        return self.b.call(function, [x])

    # ---- Operations ------------------------------------------------------------------------------

    def operation(self, node: Node) -> Any:
        """The value of a node from those of its operands."""
        if node.op == "constant":
            number = -int(node.value) if node.kind == "b" else node.value
            return self.constant(self.alike(node.kind, None), number)
        args = [self.get(a, node.uniform) for a in node.args]
        op, kind = node.op, node.args[-1].kind
        if op in SIMPLE[kind]:
            return getattr(self.b, SIMPLE[kind][op])(*args)
        if op in COMPARED:
            return self.compared(COMPARED[op], kind, *args)
        if op in INTRINSIC and kind == "f":
            return self.intrinsic(INTRINSIC[op], *args)
        method = getattr(self, f"_{op}", None)
        if method is None or (kind != "f" and op in REAL):
            raise Untranslatable(f"the operation {op} on numbers of kind {kind}")
        return method(node, *args)

    def compared(self, how: str, kind: str, x: Any, y: Any) -> Any:
        b = self.b
        if kind == "f":
            compare = b.fcmp_unordered if how == "!=" else b.fcmp_ordered
        else:
            compare = b.icmp_signed if kind == "i" else b.icmp_unsigned  # true is all ones
        return self.mask(compare(how, x, y))

    def _select_n(self, node: Node, condition: Any, no: Any, yes: Any) -> Any:
        """A blend; with zero, one bit by bit is cheaper."""
        _, if_not, if_so = node.args
        if _no_bits(if_not):
            return self.bitwise(condition, yes)
        if _no_bits(if_so):
            return self.bitwise(self.b.not_(condition), no)
        return self.b.select(self.truth(condition), yes, no)

    def bitwise(self, mask: Any, value: Any) -> Any:
        """A value where the mask says so, 0 elsewhere."""
        return self.b.bitcast(self.b.and_(mask, self.b.bitcast(value, mask.type)), value.type)

    def _fma(self, node: Node, x: Any, y: Any, z: Any) -> Any:
        product, rest = node.value.split()
        x = self.b.fneg(x) if product == "-" else x
        return self.intrinsic("fmuladd", x, y, self.b.fneg(z) if rest == "-" else z)

    def _copy(self, _: Node, x: Any) -> Any:
        return x

    def _differs(self, _: Node, x: Any, y: Any) -> Any:
        """Bit by bit: a function of -0 may not be that of 0."""
        bits = self.alike("i", x.type)
        return self.mask(self.b.icmp_signed("!=", self.b.bitcast(x, bits), self.b.bitcast(y, bits)))

    def _convert(self, node: Node, x: Any) -> Any:
        kinds = node.args[0].kind + node.kind
        of = self.alike(node.kind, x.type)
        if kinds[0] == "b":
            one = self.b.neg(x)
            return one if kinds == "bi" else self.b.sitofp(one, of)
        if kinds == "if":
            return self.b.sitofp(x, of)
        if kinds == "fi":
            return self.saturated(x, of)
        return self.compared("!=", kinds[0], x, self.constant(x.type, ZERO[kinds[0]]))

    def _sign(self, _: Node, x: Any) -> Any:
        zero, one = self.constant(x.type, 0.0), self.constant(x.type, 1.0)
        none = self.b.fcmp_unordered("==", x, zero)  # NaN stays as well
        return self.b.select(none, x, self.intrinsic("copysign", one, x))

    def _square(self, _: Node, x: Any) -> Any:
        return self.b.fmul(x, x)

    def _integer_pow(self, node: Node, x: Any) -> Any:
        if node.value not in (2, 3):
            raise Untranslatable(f"the power {node.value}")
        square = self.b.fmul(x, x)
        return square if node.value == 2 else self.b.fmul(square, x)

    def _max(self, node: Node, x: Any, y: Any) -> Any:
        return self._extreme(">", node, x, y)

    def _min(self, node: Node, x: Any, y: Any) -> Any:
        return self._extreme("<", node, x, y)

    def _extreme(self, how: str, node: Node, x: Any, y: Any) -> Any:
        """NaN if one is; of two zeros the second, whatever its sign."""
        one = self.b.select(self.truth(self.compared(how, node.kind, x, y)), x, y)
        if node.kind != "f":
            return one
        return self.b.select(self.b.fcmp_unordered("uno", x, x), x, one)  # y, where that is NaN

    def _is_finite(self, _: Node, x: Any) -> Any:
        infinite = self.constant(x.type, float("inf"))
        return self.mask(self.b.fcmp_ordered("<", self.intrinsic("fabs", x), infinite))

    def _exp(self, _: Node, x: Any) -> Any:
        """exp(x) = 2^n exp(r) with |r| <= ln(2)/2; 0 where the result would not be normal."""
        b, single = self.b, self.bits == 32
        number = lambda c: self.constant(x.type, c)  # noqa: E731
        fma = lambda p, q, r: self.intrinsic("fmuladd", p, q, r)  # noqa: E731
        digits, powers = (23, EXP_SINGLE) if single else (52, EXP_DOUBLE)
        # ln 2 in two parts, the first so short that n times it is exact
        long, short = (
            (0.693359375, -2.12194440e-4)
            if single
            else (0.693145751953125, 1.42860682030941723212e-6)
        )
        least, most = (-87.3, 88.7228) if single else (-708.3, 709.7827)
        shift = number(1.5 * 2.0**digits)  # adding it rounds to a whole number, in the last bits
        shifted = b.fadd(b.fmul(x, number(1.4426950408889634)), shift)
        n = b.fsub(shifted, shift)
        r = fma(n, number(-short), fma(n, number(-long), x))
        square = b.fmul(r, r)
        p, *pairs = (
            fma(number(c), r, number(d)) for c, d in zip(powers[::2], powers[1::2], strict=True)
        )
        for pair in pairs:  # side by side: half the latency of Horner's rule
            p = fma(p, square, pair)
        p = b.fadd(fma(square, p, r), number(1.0))
        whole = self.alike("i", x.type)
        exponent = b.shl(b.bitcast(shifted, whole), self.constant(whole, digits))
        scaled = b.bitcast(b.add(b.bitcast(p, whole), exponent), x.type)
        scaled = b.select(b.fcmp_ordered("<", x, number(least)), number(0.0), scaled)
        scaled = b.select(b.fcmp_ordered(">", x, number(most)), number(float("inf")), scaled)
        return b.select(b.fcmp_unordered("uno", x, x), x, scaled)
