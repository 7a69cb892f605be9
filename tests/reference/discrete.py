"""The discretisation of model.md for one scenario: scalar float64, one step after the other.

Order inside a step: Algorithm 2 if it ticks, mode and e_M, RK4 with both held, measurement.
Sample k is taken at the end of step k, at time (k+1) dt.
"""

from math import copysign, inf

import numpy as np

from .laws import (
    STILL,
    Choices,
    Params,
    environment,
    explore,
    first_measurement,
    in_contact,
    start_reference,
    torque,
)

FIELDS = ("t", "x", "v", "x_h", "e", "e_M", "diverging", "torque", "tau_env", "work")


def simulate(p: Params, choices: Choices, dt: float, n_steps: int) -> dict[str, np.ndarray]:
    """The trajectory as one array of n_steps samples per name in FIELDS.

    `work` is the energy in J that the torque delivers within the step; `diverging` is the mode
    that was held during the step (bool); the rest is in rad, rad/s, N·m and s.
    """
    law, contact, feedback = choices["law"], choices["contact"], choices["feedback"]
    ticks_every = round(p["period"] / dt)
    x, v = p["x_init"], p["v_init"]
    x_h, e_M, e_last = start_reference(p), 0.0, 0.0
    F = first_measurement(p, choices)
    samples = []
    for k in range(n_steps):
        if k % ticks_every == 0:
            x_h = explore(x, x_h, F, p)
        e = x_h - x
        diverging = diverges(e, v, e_last, choices["divergence"])
        e_M = peak(e, e_M, diverging, choices["peak"])
        e_last = e
        x, v, work = rk4(x, v, x_h, e_M, diverging, p, choices, dt)
        T = torque(x_h - x, e_M, diverging, p, law)
        tau = environment(x, v, p, contact)
        F = T if feedback == "motor" else tau
        samples.append(((k + 1) * dt, x, v, x_h, x_h - x, e_M, diverging, T, tau, work))
    columns = zip(*samples, strict=True)
    return {name: np.array(column) for name, column in zip(FIELDS, columns, strict=True)}


def diverges(e: float, v: float, e_last: float, divergence: str) -> bool:
    """Whether the motion leaves x_h; e_last is the error at the step before (0 at the start)."""
    if divergence == "error_rate":
        return abs(e) > abs(e_last)
    if divergence == "velocity_band" and abs(v) < STILL:
        return True
    return e * v <= 0.0


def peak(e: float, e_M: float, diverging: bool, rule: str) -> float:
    """The signed peak error e_M in rad that the attractor remembers, Algorithm 1."""
    if diverging:
        return e
    if rule == "running" and (abs(e) > abs(e_M) or e * e_M < 0.0):
        return e
    return e_M


def rk4(
    x: float,
    v: float,
    x_h: float,
    e_M: float,
    diverging: bool,
    p: Params,
    choices: Choices,
    dt: float,
) -> tuple[float, float, float]:
    """One classic Runge-Kutta step of I ẍ = torque - τ_env: x, v and the work ∫ torque v dt."""

    def rates(x: float, v: float) -> tuple[float, float, float]:
        T = torque(x_h - x, e_M, diverging, p, choices["law"])
        return v, (T - environment(x, v, p, choices["contact"])) / p["I"], T * v

    x1, v1, w1 = rates(x, v)
    x2, v2, w2 = rates(x + 0.5 * dt * x1, v + 0.5 * dt * v1)
    x3, v3, w3 = rates(x + 0.5 * dt * x2, v + 0.5 * dt * v2)
    x4, v4, w4 = rates(x + dt * x3, v + dt * v3)
    return (
        x + dt / 6.0 * (x1 + 2.0 * x2 + 2.0 * x3 + x4),
        v + dt / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4),
        dt / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4),
    )


def metrics(
    traj: dict[str, np.ndarray], p: Params, choices: Choices, dt: float
) -> dict[str, float]:
    """The metrics of model.md from a stored trajectory; times in s, torques in N·m, energy in J."""
    T, Td = traj["tau_env"], p["Td"]
    T_n = copysign(min(abs(Td), p["Fmax"]), Td)
    eps = (T - Td) / T_n
    tail = eps[len(T) // 2 :]
    touch = np.array([in_contact(x, p, choices["contact"]) for x in traj["x"]])
    finite = np.all(np.isfinite(traj["x"])) and np.all(np.isfinite(traj["v"]))
    return {
        "nmse": float(np.mean(eps**2)),
        "nmse_tail": float(np.mean(tail**2)),
        "convergence_time": settled_from(np.abs(T - T_n) / abs(T_n) <= 0.05, dt),
        "steady_error": float(np.mean(tail)),
        "peak_torque": float(np.max(np.abs(T))),
        "overshoot": max(float(np.max(T / T_n)) - 1.0, 0.0),
        "contact_time": (int(np.argmax(touch)) + 1) * dt if touch.any() else inf,
        "contact_lost": dt * int(np.sum(~touch[np.argmax(touch) :])) if touch.any() else 0.0,
        "mode_switches": float(np.sum(traj["diverging"][1:] != traj["diverging"][:-1])),
        "energy_in": float(np.sum(traj["work"])),
        "finite": float(finite),
    }


def settled_from(inside: np.ndarray, dt: float) -> float:
    """Time in s of the first sample from which `inside` holds to the end; inf if never."""
    if not inside[-1]:
        return inf
    outside = np.flatnonzero(~inside)
    first = int(outside[-1]) + 1 if outside.size else 0
    return (first + 1) * dt
