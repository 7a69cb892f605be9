"""Random programs of hints, exponentials, loop-carried values and loops."""

import random

import jax
import jax.numpy as jnp

from fic_jax.lanes import where_rare

N_COLUMNS, N_RESULTS = 3, 4


def program(seed):
    """A function of N_COLUMNS columns and a constant, the same each time it is traced."""

    def run(x, y, z, constant):
        chance = random.Random(seed)
        values, conditions = [x, y, z, constant], [x > 0.0, y > z]
        for _ in range(2):
            values += loop(chance, values, conditions, 1)
            grow(chance, values, conditions, 4, 1)
        return [chance.choice(values[-8:]) for _ in range(N_RESULTS)]

    return run


def grow(chance, values, conditions, size, depth):
    """Add `size` random operations on the values and conditions so far."""

    def one():
        return chance.choice(values[-8:] if chance.random() < 0.7 else values)

    for _ in range(size):
        kind = chance.random()
        if kind < 0.15:
            values.append(jnp.exp(-jnp.abs(one())))
        elif kind < 0.2:
            values.append(one() / one())
        elif kind < 0.4:
            values.append(chance.choice([jnp.add, jnp.subtract, jnp.multiply])(one(), one()))
        elif kind < 0.5:
            conditions.append(chance.choice([jnp.less, jnp.greater_equal, jnp.equal])(one(), one()))
        elif kind < 0.6:
            a, b = chance.choice(conditions), chance.choice(conditions)
            conditions.append(chance.choice([a & b, a | b, ~a]))
        elif kind < 0.95 or depth > 1:
            rare(chance, values, conditions, one)
        else:
            values += loop(chance, values, conditions, depth + 1)


def rare(chance, values, conditions, one):
    """Add a where, or a hint: one result or two, sometimes with a hint inside it."""
    condition, x, other = chance.choice(conditions[-5:]), one(), one()
    kind, inner = chance.random(), chance.choice(conditions)
    if kind < 0.25:
        values.append(jnp.where(condition, jnp.exp(x * 0.5), other))
    elif kind < 0.6:
        values.append(where_rare(condition, lambda: jnp.exp(x * 0.5) + other, x))
    elif kind < 0.8:
        values += where_rare(condition, lambda: (jnp.exp(other), x * jnp.exp(x)), (x, other))
    else:

        def nested():
            y = jnp.exp(-jnp.abs(x))
            return where_rare(inner, lambda: jnp.exp(y) * other, y)

        values.append(where_rare(condition, nested, other))


def loop(chance, outer_values, outer_conditions, depth):
    """The results of a loop that carries some values unchanged from iteration to iteration."""
    inits = tuple(chance.choice(outer_values) for _ in range(chance.randint(1, 4)))
    iterations, size, end = chance.randint(1, 5), chance.randint(4, 20), []
    begin = chance.getstate()

    def body(_, carry):
        chance.setstate(begin)
        values, conditions = [*outer_values, *carry], list(outer_conditions)
        outs = []
        for last in carry:
            conditions.append(chance.choice(values) > chance.choice(values))
            carried = jnp.where(conditions[-1], chance.choice(values), last)
            values += [carried, jnp.exp(-jnp.abs(carried)), last]
            outs.append(carried)
        grow(chance, values, conditions, size, depth)
        free = [chance.random() < 0.5 for _ in outs]
        outs = [chance.choice(values) if f else o for f, o in zip(free, outs, strict=True)]
        end[:] = [chance.getstate()]
        return tuple(outs)

    results = list(jax.lax.fori_loop(0, iterations, body, inits))
    chance.setstate(end[0])
    return results
