"""A scenario: its numbers (`Params`, a pytree) and its choices (`Model`, static), both checked."""

import dataclasses
import inspect
import operator
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np

from fic_jax.display import Displayed, Row, Table, is_default, row
from fic_jax.inputs import (
    ParamsError,
    Scalar,
    UnknownFieldError,
    alike,
    expect,
    float_type,
    on_host,
    real,
    shown,
    strong,
)

MAX_TICKS = 2**31 - 1  # plant steps of a control period are counted in int32


def _quantity(default: float, unit: str, meaning: str, bound: str = "finite") -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "bound": bound})


@dataclass(frozen=True, repr=False)
class Params(Displayed):
    """The numbers of one scenario (scalars), or of N scenarios ([N] leaves), in SI units.

    The defaults are the paper's: a rotation about one axis (Sec. IV). A sweep may vary each field.
    Raises ParamsError for a text or a complex number. All other values are checked when they are
    used, because JAX puts tracers, shapes, None or a PartitionSpec into the leaves. Labels of the
    fields, as an optimiser may want them, are made with `jax.tree.map`.
    """

    K0: Scalar = _quantity(100.0, "N*m/rad", "constant stiffness of the controller", "positive")
    Fmax: Scalar = _quantity(15.0, "N*m", "saturation torque", "positive")
    x0: Scalar = _quantity(0.10, "rad", "error where the linear spring ends", "positive")
    xb: Scalar = _quantity(0.11, "rad", "error where the torque saturates", "positive")
    S: Scalar = _quantity(20.0, "1", "sharpness of the saturation, b = (xb - x0)/S", "positive")
    Td: Scalar = _quantity(5.0, "N*m", "desired interaction torque", "non-zero")
    xd: Scalar = _quantity(0.0, "rad", "displacement at which contact is expected")
    sigma: Scalar = _quantity(0.01, "1", "search resolution of the exploration", "non-negative")
    period: Scalar = _quantity(0.01, "s", "control period of the exploration", "positive")
    I: Scalar = _quantity(10.0, "kg*m^2", "inertia", "positive")  # noqa: E741  the paper's symbol
    Kenv: Scalar = _quantity(100.0, "N*m/rad", "stiffness of the environment", "non-negative")
    Denv: Scalar = _quantity(189.7, "N*m*s/rad", "damping of the environment", "non-negative")
    gap: Scalar = _quantity(0.0, "rad", "position of the environment")
    x_init: Scalar = _quantity(0.0, "rad", "initial position")
    v_init: Scalar = _quantity(0.0, "rad/s", "initial velocity")

    def __new__(cls, *_: Any, **named: Any) -> "Params":
        """Raise UnknownFieldError for a field that Params does not have."""
        return _with_known_fields(cls, named)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, NO_NUMBERS) or (
                isinstance(value, np.ndarray) and value.dtype.kind in "SUc"
            ):
                real(name, value, QUANTITIES[name]["unit"])

    def _table(self) -> Table:
        rows = {name: row(name, value, QUANTITIES[name]) for name, value in vars(self).items()}
        papers = [
            name
            for name, value in vars(self).items()
            if is_default(value, Params.__dataclass_fields__[name].default)
        ]
        own = [row for name, row in rows.items() if name not in papers]
        return Table("Params", own, "as in the paper", [rows[name] for name in papers])


def meaning(about: Mapping[str, str]) -> str:
    """Meaning and unit of a field, from its metadata; empty if it has none."""
    if not about:
        return ""
    return about["meaning"] + (f", in {about['unit']}" if about["unit"] != "1" else "")


QUANTITIES = {f.name: f.metadata for f in dataclasses.fields(Params)}
NO_NUMBERS = (str, bytes, complex, np.complexfloating)
_leaves = operator.attrgetter(*QUANTITIES)
_KEYS = [jax.tree_util.GetAttrKey(name) for name in QUANTITIES]


def _params_of(_: Any, leaves: Iterable[Any]) -> Params:
    """Params with any leaves, unchecked: `jax.tree.map` may make labels of them."""
    params = object.__new__(Params)
    vars(params).update(zip(QUANTITIES, leaves, strict=True))
    return params


# `register_dataclass` would call the constructor, with its checks, which takes 11 us; this takes 5.
jax.tree_util.register_pytree_with_keys(
    Params,
    lambda params: (tuple(zip(_KEYS, _leaves(params), strict=True)), None),
    _params_of,
    lambda params: (_leaves(params), None),
)
Record = TypeVar("Record")


def _with_known_fields(cls: type[Record], named: dict[str, Any]) -> Record:
    """A new object, if its class has the named fields."""
    fields = cls.__dataclass_fields__  # type: ignore[attr-defined]
    if unknown := [name for name in named if name not in fields]:
        known = {name: meaning(field.metadata) for name, field in fields.items()}
        raise UnknownFieldError(cls.__name__, unknown[0], named[unknown[0]], known)
    return object.__new__(cls)


Law = Literal["algorithm1", "effort", "energy"]
Divergence = Literal["velocity", "error_rate", "velocity_band"]
Peak = Literal["latched", "running"]
Expectation = Literal["displacement", "error"]
Feedback = Literal["interaction", "motor"]
Contact = Literal["hard_stop", "damped_rebound", "welded"]
Integrator = Literal["rk4", "rk4_events"]


@dataclass(frozen=True)
class Model:
    """The choices between readings of the paper; static for JAX. Each default is the first option.

    law: slope of the converging branch (Algorithm 1)
        `algorithm1`: 4 E_K(e_M)/e_M^2 where |e| <= x0 and 2 F_K(e_M)/e_M beyond, as printed;
        `effort`: 2 F_K(e_M)/e_M everywhere; `energy`: 4 E_K(e_M)/e_M^2 everywhere.
    divergence: when the attractor diverges
        `velocity`: e v <= 0; `error_rate`: |e| has grown since the last plant step;
        `velocity_band`: as `velocity`, and also while |v| < 0.01 rad/s.
    peak: the peak error e_M while converging
        `latched`: constant; `running`: follows an error that is larger or of the other sign.
    expectation: when Algorithm 2 searches, because the expected contact xd has been passed
        `displacement`: |x| > |xd|, as its text says; `error`: |xd - x| > |xd|, as it is printed.
    feedback: the torque that Algorithm 2 measures, `interaction` (tau_env) or `motor`.
    contact: `hard_stop` (undamped rebound, does not pull), `damped_rebound` or `welded`.
    integrator: `rk4`, Simulink's ode4; `rk4_events`, RK4 with its switches located in the step.

    Raises ParamsError if a choice is not one of these, or if there is no such choice.
    """

    law: Law = "algorithm1"
    divergence: Divergence = "velocity"
    peak: Peak = "latched"
    expectation: Expectation = "displacement"
    feedback: Feedback = "interaction"
    contact: Contact = "hard_stop"
    integrator: Integrator = "rk4"

    def __repr__(self) -> str:
        """The choices that are not the default: as Python writes them, for help() and logs."""
        own = [f"{n}={getattr(self, n)!r}" for n, o in CHOICES.items() if getattr(self, n) != o[0]]
        return f"Model({', '.join(own)})"

    def _repr_html_(self) -> str:
        rows = [
            Row(name, getattr(self, name), meaning=f"one of {', '.join(options)}")
            for name, options in CHOICES.items()
        ]
        defaults = [row for row in rows if row.value == CHOICES[row.name][0]]
        own = [row for row in rows if row not in defaults]
        return Table("Model", own, "by default", defaults).html()

    def __new__(cls, *_: Any, **named: Any) -> "Model":
        """Raise UnknownFieldError for a choice that Model does not have."""
        return _with_known_fields(cls, named)

    # Checked here, unlike Params: a Model is no pytree, so JAX makes none with tracers.
    def __post_init__(self) -> None:
        for name, options in CHOICES.items():
            value = getattr(self, name)
            if not isinstance(value, str) or value not in options:
                raise ParamsError(name, shown(value), "one of " + ", ".join(options))

    def with_events(self) -> "Model":
        """The same choices with the integrator `rk4_events`."""
        return dataclasses.replace(self, integrator="rk4_events")


# `help`, and completion in a notebook, would show the arguments of `__new__`.
for _record in (Params, Model):
    _, *_arguments = inspect.signature(_record.__init__).parameters.values()
    setattr(_record, "__signature__", inspect.Signature(_arguments))  # noqa: B010  mypy

CHOICES: dict[str, tuple[str, ...]] = {
    "law": get_args(Law),
    "divergence": get_args(Divergence),
    "peak": get_args(Peak),
    "expectation": get_args(Expectation),
    "feedback": get_args(Feedback),
    "contact": get_args(Contact),
    "integrator": get_args(Integrator),
}

# Of many numbers the extremes are looked at first, in parts that threads share.
MANY, PART = 10_000, 1_000_000
Each = Callable[..., Iterable[Any]]
_BOUNDS = {
    "finite": lambda a: np.ones(a.shape, bool),
    "positive": lambda a: a > 0,
    "non-negative": lambda a: a >= 0,
    "non-zero": lambda a: a != 0,
}


def canonical(params: Params) -> Params:
    """The parameters with all leaves in one strong float dtype: numbers and arrays trace alike.

    It is the widest one of the leaves that are floats, at least float32; without such a leaf it is
    JAX's, float32 by default and float64 with x64 on. Integers become floats. In `jax.shard_map`
    all leaves vary over the mesh axes over which one of them varies.

    Raises ParamsError for a leaf that is no real number.
    """
    return alike(of_one_type("params", params))


def of_one_type(key: str, params: Any) -> Params:
    """`canonical` without `alike`; `key` names the argument in a message."""
    expect(key, params, Params, "Params(K0=100.0)")
    leaves = {
        name: real(name, value, QUANTITIES[name]["unit"]) for name, value in vars(params).items()
    }
    dtype = float_type(leaves.values())
    with np.errstate(over="ignore", under="ignore"):  # checked as the inf or zero it becomes
        return Params(**{name: strong(leaf, dtype) for name, leaf in leaves.items()})


def steps_per_period(period: Scalar, dt: Scalar) -> jax.Array:
    """Plant steps between two ticks of Algorithm 2: a whole number, at least 1."""
    return jnp.maximum(jnp.floor(period / dt + 0.5), 1.0).astype(jnp.int32)


def check_model(model: Any) -> None:
    """Raise ParamsError unless it is a Model; of an option's name, the message makes one."""
    names = [
        name for name, options in CHOICES.items() if isinstance(model, str) and model in options
    ]
    example = f'Model({names[0]}="{model}")' if names else 'Model(contact="welded")'
    expect("model", model, Model, example)


def check_field(name: str, values: Any, dt: float | None = None, each: Each = map) -> None:
    """Raise ParamsError unless every value of one field is finite and within its bound.

    `period` must also be a whole multiple of `dt`, within 1e-6: float32 rounds 0.01 by 2e-8.
    `each` is `map`, or that of a pool of threads.
    """
    numbers = on_host(real(name, values, QUANTITIES[name]["unit"]))
    bound = QUANTITIES[name]["bound"]
    if np.size(numbers) >= MANY:
        numbers = _suspects(name, np.asarray(numbers), bound, each)
    a = np.atleast_1d(np.asarray(numbers, np.float64))
    wanted = bound if bound == "finite" else f"{bound} and finite"
    with np.errstate(invalid="ignore"):
        bad = ~(np.isfinite(a) & _BOUNDS[bound](a))
    if bad.any():
        raise ParamsError(name, f"{a[bad][0]:g}", wanted)
    if name == "period" and dt is not None:
        with np.errstate(over="ignore"):
            ticks = a / dt
        if (ticks > MAX_TICKS).any():
            raise ParamsError(name, f"{a.max():g}", f"at most {MAX_TICKS:,} steps of dt")
        bad = (np.abs(ticks - np.round(ticks)) > 1e-6 * ticks) | (ticks < 0.5)
        if bad.any():
            near = max(round(ticks[bad][0]), 1) * dt
            wanted = f"a whole multiple of dt = {dt:g} s (nearest: {near:.6g})"
            raise ParamsError(name, f"{a[bad][0]:.6g}", wanted)


def _suspects(name: str, numbers: np.ndarray, bound: str, each: Each) -> np.ndarray:
    """The extremes alone where no other number can be wrong, or else all numbers."""
    low, high = ends = extremes(numbers, each)
    with np.errstate(invalid="ignore"):
        right = np.isfinite(ends).all() and _BOUNDS[bound](ends).all()
    between = (bound == "non-zero" and low < 0 < high) or (name == "period" and low < high)
    return ends if right and not between else numbers


def extremes(numbers: np.ndarray, each: Each) -> np.ndarray:
    """The least and the largest number, both NaN if one is."""
    parts = np.array_split(numbers.reshape(-1), numbers.size // PART + 1)
    ends = [*each(lambda part: (np.min(part), np.max(part)), parts)]
    return np.array([np.min(ends), np.max(ends)], np.float64)


def check_scalars(params: Params) -> None:
    """Raise ParamsError unless every leaf is a scalar."""
    for name, leaf in vars(params).items():
        if np.ndim(leaf):
            wanted = "a scalar (sweep takes [N] leaves, vmap makes scalars of them)"
            raise ParamsError(name, f"of shape {np.shape(leaf)}", wanted)


def check_step(dt: Any) -> None:
    """Raise ParamsError unless the plant step is a positive and finite number. Tracers pass."""
    try:
        number = real("dt", dt)
    except ParamsError as error:
        raise ParamsError("dt", error.value, "a positive number of seconds") from None
    if isinstance(number, jax.core.Tracer):
        return
    if np.ndim(number):
        raise ParamsError("dt", f"of shape {np.shape(number)}", "one number of seconds for all")
    seconds = float(on_host(number))
    if not (np.isfinite(seconds) and seconds > 0):
        raise ParamsError("dt", f"{seconds:g}", "positive and finite")


def check(params: Params, dt: Scalar) -> None:
    """Raise ParamsError for the first wrong value; leaves may be `[N]` arrays.

    The public functions call it once, before JAX traces. Tracers have no values: they pass.
    """
    check_step(dt)
    known = {n: v for n, v in vars(params).items() if not isinstance(v, jax.core.Tracer)}
    step = None if isinstance(dt, jax.core.Tracer) else float(on_host(dt))
    large = any(np.size(values) > PART for values in known.values())
    with ThreadPoolExecutor() if large else nullcontext() as pool:
        each = pool.map if pool else map
        for name, values in known.items():
            check_field(name, values, step, each)
        if {"x0", "xb"} <= known.keys():
            x0, xb = (np.asarray(on_host(known[name])) for name in ("x0", "xb"))
            _check_order(x0, xb, each)


def _check_order(x0: np.ndarray, xb: np.ndarray, each: Each) -> None:
    """Raise ParamsError unless xb is greater than x0."""
    if max(x0.size, xb.size) >= MANY and extremes(x0, each)[1] < extremes(xb, each)[0]:
        return
    x0, xb = np.broadcast_arrays(x0, xb)
    if (xb <= x0).any():
        first = np.argmax(np.ravel(xb <= x0))
        raise ParamsError("xb", f"{xb.flat[first]:g}", f"greater than x0 = {x0.flat[first]:g}")
