"""The laws of model.md for one scenario, in plain Python floats with ordinary branches.

Units are SI: torque in N·m, angle in rad, energy in J. Parameters and choices carry the names of
model.md; choices without `expectation` mean `displacement`. Nothing here is shared with
`fic_jax`; that is the point of this package.
"""

from math import copysign, exp

Params = dict[str, float]
Choices = dict[str, str]

STILL = 0.01
"""|v| below which `velocity_band` counts the motion as stopped, in rad/s (model.md)."""

BAND = 0.05
"""A torque that stays this close to T_n, in parts of T_n, has converged (model.md)."""
LEAST_STAY = 0.05
"""It has to stay for at least this part of the run to count as converged (model.md)."""


def force(e: float, p: Params) -> float:
    """Force profile F_K(e) in N·m, eq. 1: linear to x0, exponential to xb, then Fmax."""
    K0, Fmax, x0, xb = p["K0"], p["Fmax"], p["x0"], p["xb"]
    b = (xb - x0) / p["S"]
    dF = Fmax - K0 * x0
    if abs(e) < x0:
        return K0 * e
    if abs(e) < xb:
        return copysign(dF * (1.0 - exp(-(abs(e) - x0) / b)) + K0 * x0, e)
    return copysign(Fmax, e)


def energy(e: float, p: Params) -> float:
    """Spring energy E_K(e) = ∫ F_K from 0 to |e| in J, eq. 2 read as that integral.

    Exact also where F_K jumps by exp(-S) ΔF at xb; E_K itself is continuous there.
    """
    K0, Fmax, x0, xb = p["K0"], p["Fmax"], p["x0"], p["xb"]
    b = (xb - x0) / p["S"]
    dF = Fmax - K0 * x0
    if abs(e) < x0:
        return 0.5 * K0 * e * e
    spent = 1.0 - exp(-(min(abs(e), xb) - x0) / b)
    return Fmax * (abs(e) - x0) + 0.5 * K0 * x0 * x0 - b * dF * spent


def diverges(e: float, v: float, e_last: float, divergence: str) -> bool:
    """Whether the motion leaves x_h; e_last is the error at the step before (0 at the start)."""
    if divergence == "error_rate":
        return abs(e) > abs(e_last)
    if divergence == "velocity_band" and abs(v) < STILL:
        return True
    return e * v <= 0.0


def slope(e: float, e_M: float, p: Params, law: str) -> float:
    """Converging stiffness in N·m/rad, Algorithm 1: 4E/e_M² or 2F/e_M, by law and by |e|.

    Where |e_M| <= x0 the spring is linear and both are 2 K0, which is also the limit at e_M = 0.
    """
    if abs(e_M) <= p["x0"]:
        return 2.0 * p["K0"]
    if law == "effort" or (law == "algorithm1" and abs(e) > p["x0"]):
        return 2.0 * force(e_M, p) / e_M
    return 4.0 * energy(e_M, p) / (e_M * e_M)


def limited(torque: float, p: Params) -> float:
    """The torque within ±Fmax, N·m; the value comes first in min and max so that NaN survives."""
    return max(min(torque, p["Fmax"]), -p["Fmax"])


def torque(e: float, e_M: float, diverging: bool, p: Params, law: str) -> float:
    """Controller torque in N·m, Algorithm 1: F_K(e), or slope (e - e_M/2) on the way back."""
    if diverging:
        return limited(force(e, p), p)
    return limited(slope(e, e_M, p, law) * (e - 0.5 * e_M), p)


def in_contact(x: float, p: Params, contact: str) -> bool:
    """Whether the environment touches: always when welded, else from x = gap on."""
    return contact == "welded" or x >= p["gap"]


def environment(x: float, v: float, p: Params, contact: str) -> float:
    """Interaction torque τ_env in N·m, positive where it pushes the inertia back."""
    if not in_contact(x, p, contact):
        return 0.0
    spring = p["Kenv"] * (x - p["gap"])
    if contact == "hard_stop":
        return spring + p["Denv"] * max(v, 0.0)
    return spring + p["Denv"] * v


def start_reference(p: Params) -> float:
    """The reference x_h = xd + Td/K0 in rad that Algorithm 2 starts from and returns to."""
    return p["xd"] + p["Td"] / p["K0"]


def reachable(p: Params) -> float:
    """T_n = sgn(Td) min(|Td|, Fmax) in N·m: the part of Td that the motor can give."""
    return copysign(min(abs(p["Td"]), p["Fmax"]), p["Td"])


def explore(x: float, x_h: float, F: float, p: Params, expectation: str = "displacement") -> float:
    """The next reference x_h in rad, Algorithm 2; F is the measured torque in N·m."""
    Td, K0 = p["Td"], p["K0"]
    if Td == F:
        return x_h
    travelled = abs(p["xd"] - x) if expectation == "error" else abs(x)
    if travelled <= abs(p["xd"]):
        return start_reference(p)
    return x_h + (Td - F) / Td * p["sigma"] * Td / K0


def first_measurement(p: Params, choices: Choices) -> float:
    """The torque F in N·m that Algorithm 2 sees at t = 0: nothing has moved the motor yet."""
    if choices["feedback"] == "motor":
        return 0.0
    return environment(p["x_init"], p["v_init"], p, choices["contact"])
