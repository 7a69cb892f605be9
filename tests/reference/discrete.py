"""The discretisation of model.md for one scenario: scalar float64, one step after the other.

Order inside a step: Algorithm 2 if it ticks, mode and e_M, RK4 with both held, measurement.
Sample k is taken at the end of step k, at time (k+1) dt.
"""

from math import inf

import numpy as np

from .laws import (
    BAND,
    LEAST_STAY,
    Choices,
    Params,
    diverges,
    environment,
    explore,
    first_measurement,
    in_contact,
    reachable,
    start_reference,
    torque,
)

FIELDS = ("t", "x", "v", "x_h", "e", "e_M", "diverging", "torque", "tau_env")
INTEGRALS = ("work", "eps", "square")


def simulate(p: Params, choices: Choices, dt: float, n_steps: int) -> dict[str, np.ndarray]:
    """The trajectory as one array of n_steps samples per name in FIELDS and INTEGRALS.

    `diverging` is the mode that was held during the step (bool); the other FIELDS are in rad,
    rad/s, N·m and s. The INTEGRALS are over the step: `work` of the torque in J, `eps` and
    `square` of ε = (τ_env - Td)/T_n and of ε² in s.
    """
    law, contact, feedback = choices["law"], choices["contact"], choices["feedback"]
    expectation = choices.get("expectation", "displacement")
    ticks_every = round(p["period"] / dt)
    x, v = p["x_init"], p["v_init"]
    x_h, e_last = start_reference(p), 0.0
    e_M = x_h - x
    F = first_measurement(p, choices)
    samples = []
    for k in range(n_steps):
        if k % ticks_every == 0:
            x_h = explore(x, x_h, F, p, expectation)
        e = x_h - x
        diverging = diverges(e, v, e_last, choices["divergence"])
        e_M = peak(e, e_M, diverging, choices["peak"])
        e_last = e
        x, v, *integrals = rk4(x, v, x_h, e_M, diverging, p, choices, dt)
        T = torque(x_h - x, e_M, diverging, p, law)
        tau = environment(x, v, p, contact)
        F = T if feedback == "motor" else tau
        samples.append(((k + 1) * dt, x, v, x_h, x_h - x, e_M, diverging, T, tau, *integrals))
    names, columns = FIELDS + INTEGRALS, zip(*samples, strict=True)
    return {name: np.array(column) for name, column in zip(names, columns, strict=True)}


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
) -> tuple[float, ...]:
    """One classic Runge-Kutta step of I ẍ = torque - τ_env and of three integrals from 0.

    Returns x (rad), v (rad/s), ∫ torque v dt (J), ∫ ε dt and ∫ ε² dt (s).
    """
    T_n = reachable(p)

    def rates(x: float, v: float) -> tuple[float, ...]:
        T = torque(x_h - x, e_M, diverging, p, choices["law"])
        tau = environment(x, v, p, choices["contact"])
        eps = (tau - p["Td"]) / T_n
        return v, (T - tau) / p["I"], T * v, eps, eps * eps

    k1 = rates(x, v)
    k2 = rates(x + 0.5 * dt * k1[0], v + 0.5 * dt * k1[1])
    k3 = rates(x + 0.5 * dt * k2[0], v + 0.5 * dt * k2[1])
    k4 = rates(x + dt * k3[0], v + dt * k3[1])
    stages = zip(k1, k2, k3, k4, strict=True)
    dx, dv, *integrals = (dt / 6.0 * (a + 2.0 * b + 2.0 * c + d) for a, b, c, d in stages)
    return x + dx, v + dv, *integrals


def metrics(
    traj: dict[str, np.ndarray], p: Params, choices: Choices, dt: float
) -> dict[str, float]:
    """The metrics of model.md from a stored trajectory; times in s, torques in N·m, energy in J.

    The initial state is a sample too, at time 0; it is taken from the parameters.
    """
    contact, n_steps = choices["contact"], len(traj["t"])
    tail = slice(n_steps // 2, None)
    tail_length = dt * (n_steps - n_steps // 2)
    relative = np.array([environment(p["x_init"], p["v_init"], p, contact), *traj["tau_env"]])
    relative = relative / reachable(p)
    touch = np.array([in_contact(x, p, contact) for x in (p["x_init"], *traj["x"])])
    first = int(np.argmax(touch))
    moves = np.abs(np.diff([p["x_init"], *traj["x"]])) > rounding(p) * dt / p["period"]
    branches = traj["diverging"][moves]
    finite = np.all(np.isfinite(traj["x"])) and np.all(np.isfinite(traj["v"]))
    return {
        "nmse": float(np.sum(traj["square"])) / (n_steps * dt),
        "nmse_tail": float(np.sum(traj["square"][tail])) / tail_length,
        "convergence_time": settled_from(relative, dt),
        "steady_error": float(np.sum(traj["eps"][tail])) / tail_length,
        "peak_torque": float(np.max(np.abs(relative))) * abs(reachable(p)),
        "overshoot": max(float(np.max(relative)) - 1.0, 0.0),
        "contact_time": first * dt if touch.any() else inf,
        "contact_lost": dt * int(np.sum(~touch[first:])) if touch.any() else 0.0,
        "mode_switches": float(np.sum(branches[1:] != branches[:-1])),
        "energy_in": float(np.sum(traj["work"])),
        "finite": float(finite),
    }


def rounding(p: Params) -> float:
    """The rounding of positions in rad: a joint that moves less in a control period is at rest."""
    size = abs(start_reference(p)) + abs(p["gap"]) + abs(p["x_init"]) + p["xb"]
    return 4.0 * float(np.finfo(float).eps) * size


def settled_from(relative: np.ndarray, dt: float) -> float:
    """The instant in s from which |T/T_n - 1| <= 0.05 until the end, between samples k dt.

    The crossing of the band's edge is interpolated linearly; inf unless at least 5 % of the run
    are left.
    """
    outside = np.flatnonzero(~(np.abs(relative - 1.0) <= BAND))
    if outside.size == 0:
        return 0.0
    last, t_end = int(outside[-1]), dt * (len(relative) - 1)
    if last == len(relative) - 1:
        return inf
    before, after = float(relative[last]), float(relative[last + 1])
    edge = 1.0 - BAND if before < 1.0 else 1.0 + BAND
    instant = dt * (last + (edge - before) / (after - before))
    return instant if t_end - instant >= LEAST_STAY * t_end else inf
