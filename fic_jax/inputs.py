"""What a user may give: real numbers of Python, NumPy or JAX, and records; else a message."""

import difflib
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from numbers import Real
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.dtypes import canonicalize_dtype

Scalar: TypeAlias = Any  # a float, a 0-d array or a tracer: the physics is for one scenario
MAX_SHOWN = 60  # characters of a wrong value in a message
Tree = TypeVar("Tree")

MAX_COUNT = 2**31 - 1  # loops count in int32
NO_OTHERS: Mapping[str, Sequence[str]] = {}


class ParamsError(ValueError):
    """A wrong value: `key` names it, `value` is the value, `wanted` says which would be right."""

    def __init__(self, key: str, value: object, wanted: str):
        super().__init__(f"`{key}` must be {wanted}, but is {value}.")
        self.key, self.value, self.wanted = key, value, wanted

    def __reduce__(self) -> Any:  # a process pool pickles it
        return _remade, (type(self), self.args, vars(self))


def _remade(kind: type[ParamsError], args: tuple[Any, ...], fields: dict[str, Any]) -> ParamsError:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


class UnknownFieldError(ParamsError, TypeError):
    """A field that the record does not have. Python users expect a TypeError."""

    def __init__(self, record: str, key: str, value: object, known: Mapping[str, str]):
        super().__init__(key, value, f"a field of {record}")
        self.args = (f"unknown field `{key}` of {record}{hint(key, known)}",)


MOST_MEANT = 4  # more, as for `of`, would be no hint


def hint(
    word: str, known: Mapping[str, str], other_words: Mapping[str, Sequence[str]] = NO_OTHERS
) -> str:
    """'; did you mean `x` (its meaning)?' if `word` is near known words, else all of these.

    It is near if it describes one, begins a part of one (`conv`, `lost`), or resembles one.

    `known` has the meaning of each, or an empty text; `other_words` what it is called elsewhere.
    """
    lower, given = {name.lower(): name for name in known}, word.lower()
    described = [
        name
        for name, meaning in known.items()
        if given in (*meaning.lower().replace(",", "").split(), *other_words.get(name, ()))
    ]
    begun = [
        name
        for small, name in lower.items()
        if len(given) > 2 and f"_{given}" in f"_{small.replace('-', '_')}"
    ]
    meant = [lower[given]] if given in lower else described or begun
    if not 0 < len(meant) <= MOST_MEANT:
        likeness = 0.6 if len(given) > 2 else 0.5  # at 0.5, conv is like Kenv, but also k3 like K0
        near = difflib.get_close_matches(given, lower, n=1, cutoff=likeness)
        meant = [lower[small] for small in near]
    if not meant:
        return "; known are " + ", ".join(known)
    names = [f"`{name}` ({known[name]})" if known[name] else f"`{name}`" for name in meant]
    return "; did you mean " + " or ".join(names) + "?"


def real(name: str, value: Any, unit: str = "1") -> Scalar:
    """A real number or an array of them, as Python's float, NumPy's or JAX's array.

    Raises ParamsError for all else: text, bools, complex numbers, dates, masked arrays, numbers
    that carry a unit, and what NumPy can't turn into numbers.
    """
    if type(value) is float:
        return value
    array = value  # a tracer is a JAX array too
    if not isinstance(value, jax.Array):
        try:
            array = None if _has_more_than_numbers(value) else np.asarray(value)
            array = _as_floats(array) if array is not None and array.dtype == object else array
        except Exception:  # a foreign __array__ may raise anything
            array = None
    if array is None or not _is_real(array.dtype):
        of = "" if unit == "1" else f" in {unit}"
        raise ParamsError(name, shown(value), f"a real number{of} or an array of real numbers")
    return array


def _has_more_than_numbers(value: Any) -> bool:
    """Whether NumPy would drop a mask or a unit: of ndarray's subclasses, pint's, xarray's."""
    if isinstance(value, np.ndarray | np.generic):
        return isinstance(value, np.ndarray) and type(value) not in (np.ndarray, np.memmap)
    holders = type(value), type(getattr(value, "data", None))
    return any(hasattr(kind, word) for kind in holders for word in ("unit", "units"))


def _as_floats(objects: np.ndarray) -> np.ndarray | None:
    """Python's own numbers, such as fractions and long integers, as floats."""
    if not all(isinstance(x, Real | Decimal) and not isinstance(x, bool) for x in objects.flat):
        return None
    return objects.astype(np.float64)


def _is_real(dtype: Any) -> bool:
    kind = getattr(dtype, "kind", "")
    if kind != "V":
        return kind in ("f", "i", "u")
    return jnp.issubdtype(dtype, np.floating) or jnp.issubdtype(dtype, np.integer)  # as bfloat16


def shown(value: Any) -> str:
    """A wrong value in a message: as Python writes it, or its type if that is long."""
    text = repr(value)
    short = len(text) <= MAX_SHOWN and text.isprintable()
    return text if short else f"of type {type(value).__name__}"


def float_type(leaves: Iterable[Scalar]) -> np.dtype:
    """The dtype of a computation with these numbers (see `canonical`)."""
    sizes = [
        leaf.dtype.itemsize
        for leaf in leaves
        if hasattr(leaf, "dtype")
        and leaf.dtype.kind not in "iu"
        and jnp.issubdtype(leaf.dtype, np.floating)
        and not getattr(leaf, "weak_type", False)
    ]
    if not sizes:
        return np.dtype(jnp.result_type(float))
    return np.dtype(canonicalize_dtype(np.float64 if max(sizes) > 4 else np.float32))


def strong(leaf: Scalar, dtype: Any) -> Scalar:
    """A leaf as a strongly typed array. Floats, integers and arrays then share one compilation."""
    if isinstance(leaf, jax.Array):
        return leaf if leaf.dtype == dtype and not leaf.weak_type else jnp.asarray(leaf, dtype)
    return np.asarray(leaf, dtype)  # 1 us; a transfer to the device takes 20


def alike(tree: Tree) -> Tree:
    """Leaves that all vary over the mesh axes of `jax.shard_map` over which one of them varies.

    A loop then carries the same types in and out: what starts as a constant gets mixed with what
    varies. Nothing changes outside of `shard_map`, or with its `check_vma=False`.
    """
    leaves, structure = jax.tree.flatten(tree)
    axes = [_varying(leaf) for leaf in leaves]
    every = frozenset().union(*axes)
    if not every:
        return tree
    missing = [tuple(sorted(every - own)) for own in axes]
    cast = [jax.lax.pcast(*one, to="varying") for one in zip(leaves, missing, strict=True)]
    return jax.tree.unflatten(structure, cast)


def _varying(leaf: Scalar) -> frozenset[str]:
    """The mesh axes over which a leaf varies."""
    if not isinstance(leaf, jax.core.Tracer):
        return frozenset()
    return jax.typeof(leaf).manual_axis_type.varying


def transferred(compiled: Callable[..., Any], *args: Any, **static: Any) -> Any:
    """Call a compiled function with host or device numbers; in `shard_map` they vary `alike`.

    A user's `jax.transfer_guard` forbids hidden transfers. The arguments are on the host because
    the user put them there: their transfer to the device is allowed.
    """
    args = alike(args)
    with jax.transfer_guard_host_to_device("allow"):
        return compiled(*args, **static)


def expect(key: str, value: Any, record: type, example: str) -> None:
    """Raise ParamsError with an example unless `value` is a record of this type."""
    if not isinstance(value, record):
        name = record.__name__
        raise ParamsError(key, shown(value), f"of type {name}, such as {example}")


def count(name: str, value: Any) -> int:
    """`value` as an int. Raises ParamsError unless it is a whole number of at least 1."""
    wanted = "a whole number, at least 1"
    if isinstance(value, jax.core.Tracer):
        raise ParamsError(name, "traced by jit, vmap or grad", f"{wanted}, and static")
    try:
        number = 0 if isinstance(value, bool) else operator.index(on_host(value))
    except TypeError:
        number = 0
    if number < 1:
        raise ParamsError(name, shown(value), wanted)
    if number > MAX_COUNT:
        raise ParamsError(name, shown(value), f"at most {MAX_COUNT:,}")
    return number


def on_host(tree: Tree) -> Tree:
    """JAX's arrays as NumPy's: an explicit transfer, which `jax.transfer_guard` lets pass."""
    if isinstance(tree, float | np.ndarray):  # as most are: 20 us saved
        return tree
    return jax.device_get(tree)
